"""The errors of gcomp: arrays or models that cannot be used."""


class GcompError(ValueError):
    """An error that the user can correct; `exit_status` is the exit status of a command that it ends."""

    exit_status = 2


class BadArray(GcompError):
    """An array of the wrong shape or with unusable values; names it and what was expected."""


class BadModel(GcompError):
    """A robot model that is not a serial arm of revolute joints; names the joint."""
