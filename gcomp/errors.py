"""The errors of gcomp: arrays or models that cannot be used."""


class GcompError(ValueError):
    """Something a user can act on; `exit_status` is what a command line that meets it exits with."""

    exit_status = 2


class BadArray(GcompError):
    """An array of the wrong shape or with values that cannot be used; says which, and what was expected."""


class BadModel(GcompError):
    """A robot model that is not a serial arm of revolute joints; names the joint."""
