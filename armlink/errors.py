"""The errors that a command turns into one line and an exit status."""


class ArmlinkError(Exception):
    """Something a user can act on; `exit_status` is what the command line exits with."""

    exit_status = 2


class BadInput(ArmlinkError):
    """A file, key, value or option that cannot be used: says which, what was expected and how to mend it."""


class Refused(ArmlinkError):
    """The work ran, but its answer is no: a check failed or a gate refused."""

    exit_status = 1


class BusFault(ArmlinkError):
    """The bus or a device on it failed; the joints were left safe."""

    exit_status = 3
