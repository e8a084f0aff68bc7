"""The end of work on an arm: how its joints were left, and where it is early the command that goes on from there."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from armlink.arm_file import ArmFile
from armlink.errors import Stall

HOLD = "the joints hold where they stand, in quick stop"
PARKED = (
    "the arm was parked or slowly lowered, and then its power was switched off, unless a line above reports a fault"
)


@dataclass
class ArmWork:
    enabled: bool = False
    """Whether the joints may have been enabled: set it just before."""


@contextlib.contextmanager
def early_end(arm: ArmFile, resume: str | Callable[[], str] | None = None) -> Iterator[ArmWork]:
    """After Ctrl-C or a stall, print how the joints were left and how to continue, once the link inside is closed.

    Enter it before the link is opened; `resume` is the command that continues the work, or a function that returns it.
    """
    work = ArmWork()
    try:
        yield work
    except (KeyboardInterrupt, Stall):
        from armlink.commands.plain_console import PlainConsole, suggest

        if work.enabled:
            PlainConsole().print(f"{arm.name}: {joints_left(arm)}")
        if resume is not None:
            suggest(resume if isinstance(resume, str) else resume())
        raise


def joints_left(arm: ArmFile) -> str:
    """How the end of work leaves the joints (`armlink.link.ends`)."""
    from armlink.link.joints.groups import make_groups, traits_of

    return HOLD if all(each.silence == "holds" for each in traits_of(make_groups(arm))) else PARKED
