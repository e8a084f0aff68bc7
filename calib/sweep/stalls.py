"""Stalls of the cycle: the joints were stopped; ask, enable them again, repeat the reading."""

from collections.abc import Callable
from typing import TypeVar

from armlink.errors import Stall
from armlink.loop.driver import ArmDriver

OnStall = Callable[[Stall], bool]
"""Told why the joints were stopped; whether to enable them again and go on."""
T = TypeVar("T")


def give_up(stall: Stall) -> bool:
    """An OnStall that does not go on."""
    return False


def restart(
    link: ArmDriver, on_stall: OnStall, stall: Stall, note: Callable[[Stall], None] = lambda stall: None
) -> None:
    """Enable the joints again as often as it takes; raises the Stall that `on_stall` does not accept."""
    while True:
        if not on_stall(stall):
            raise stall
        note(stall)
        try:
            link.recover()
        except Stall as again:
            stall = again
        else:
            return


def repeat_work(
    link: ArmDriver, on_stall: OnStall, work: Callable[[], T], resume: Callable[[], object] | None = None
) -> T:
    """Return the result of `work`; it is repeated from its beginning after each Stall that `on_stall` accepts.

    Work that moves the arm gives its mover's `resume`: the arm then holds where it stands first.
    """
    while True:
        try:
            return work()
        except Stall as stall:
            restart(link, on_stall, stall)
            if resume is not None:
                repeat_work(link, on_stall, resume)
