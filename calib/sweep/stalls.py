"""Stalls of the cycle: the joints were stopped; ask, enable them again, repeat the reading."""

from collections.abc import Callable
from typing import TypeVar

from armlink.errors import HostLate, Stall
from armlink.loop.driver import ArmDriver
from calib.dataset import StallLine
from calib.motion.mover import Mover

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


def repeat_work(link: ArmDriver, on_stall: OnStall, work: Callable[[], T]) -> T:
    """Return the result of `work`; it is repeated from its beginning after each Stall that `on_stall` accepts."""
    while True:
        try:
            return work()
        except Stall as stall:
            restart(link, on_stall, stall)


def resume_after(
    mover: Mover, on_stall: OnStall, stall: Stall, note: Callable[[Stall], None] = lambda stall: None
) -> None:
    """As `restart`; then the arm holds where it stands."""
    restart(mover.link, on_stall, stall, note)
    repeat_work(mover.link, on_stall, mover.resume)


def repeat_motion(mover: Mover, on_stall: OnStall, work: Callable[[], T]) -> T:
    """As `repeat_work`, for work that moves the arm: after a Stall it holds where it stands first."""
    while True:
        try:
            return work()
        except Stall as stall:
            resume_after(mover, on_stall, stall)


def stall_line(stall: Stall, t: float, reading: str) -> StallLine:
    """How a stall at link time `t` [s] is noted in the data set."""
    late = stall.late * 1e3 if isinstance(stall, HostLate) else None
    return StallLine(t=t, late_ms=late, reading=reading, reason=str(stall))
