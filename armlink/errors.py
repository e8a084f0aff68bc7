"""The errors that a command turns into one line and an exit status."""


class ArmlinkError(Exception):
    """Something a user can act on; `exit_status` is what the command line exits with."""

    exit_status = 2

    def __str__(self) -> str:
        """The message as one line, whatever names of files, joints or topics are in it."""
        return " ".join(super().__str__().splitlines())


class BadInput(ArmlinkError):
    """A file, key, value or option that cannot be used: says which, what was expected and how to fix it."""


class Refused(ArmlinkError):
    """The work ran, but its answer is no: a check failed or a gate refused."""

    exit_status = 1


class Declined(ArmlinkError):
    """A person answered a question with no."""

    exit_status = 130


class BusFault(ArmlinkError):
    """The bus or a device on it failed; the joints were left safe."""

    exit_status = 3


class Stall(BusFault):
    """The cycle stood still and the joints were stopped. Nothing is known to be broken: the work can be repeated."""


class HostLate(Stall):
    """This host did not keep the cycle."""

    def __init__(self, late: float, limit: float, then: str = "") -> None:
        """How late its SYNC was and how late it may be [s], and what a joint did about it."""
        told = f"the host was {late * 1e3:.0f} ms late"
        if late > limit or not then:
            super().__init__(f"{told} (limit {limit * 1e3:.0f} ms){then and f'; {then}'}")
        else:
            super().__init__(f"{told}; the consequence: {then}")
        self.late, self.limit, self.then = late, limit, then

    def __reduce__(self) -> tuple[type["HostLate"], tuple[float, float, str]]:
        return type(self), (self.late, self.limit, self.then)


class Silence(Stall):
    """No reading came from a joint for longer than `link.deadline`."""
