"""How the work on an arm ends: one table, by what its drives do and why the work ends.

Drives that hold by themselves are sent to quick stop. Drives that let go when their host falls silent need it to the
last: the arm is held, then parked in `link.park`, or let down along its own load, and only then loses its power.
"""

from contextlib import suppress
from enum import Enum

from armlink.errors import BusFault, Refused, Stall
from armlink.link.cycle import ENABLE_SECONDS
from armlink.link.park import StowableArm, cycle_count, let_down, park
from armlink.link.types import Tell
from armlink.termination import Dropped


class Response(Enum):
    """The treatment of the arm, in the words of the table in docs/safety.md."""

    QUICK_STOP = "quick stop: the drives hold"
    HOLD = "hold"
    PARK = "hold, park, power off"
    LET_GO = "let go"


class EndCause(Enum):
    """Why the work ends, in the words of the table in docs/safety.md."""

    DONE = "the work is done"
    INTERRUPTED = "Ctrl-C, Ctrl-\\, SIGTERM, SIGHUP, `systemctl stop`"
    FAILED = "an exception in the job, a full disk"
    REFUSED = "the gate refuses a command, or a joint crosses a bound"
    STALLED = "the cycle stopped, or drives stopped by themselves"
    FAULT = "a drive has a fault or falls silent; another host or a flood is on the bus"
    LOST = "the job is killed"
    SILENT = "the job is silent, or suspended (Ctrl-Z)"
    DROPPED = "Ctrl-C twice within two seconds, while parking"


ENDS: dict[EndCause, tuple[Response, Response]] = {
    EndCause.DONE: (Response.QUICK_STOP, Response.PARK),
    EndCause.INTERRUPTED: (Response.QUICK_STOP, Response.PARK),
    EndCause.FAILED: (Response.QUICK_STOP, Response.PARK),
    EndCause.REFUSED: (Response.QUICK_STOP, Response.PARK),
    EndCause.STALLED: (Response.QUICK_STOP, Response.PARK),
    EndCause.FAULT: (Response.QUICK_STOP, Response.PARK),
    EndCause.LOST: (Response.QUICK_STOP, Response.PARK),
    EndCause.SILENT: (Response.HOLD, Response.HOLD),
    EndCause.DROPPED: (Response.QUICK_STOP, Response.LET_GO),
}
"""For arms whose drives all hold, and for arms with drives that let go. A silent job has not ended: its arm is held by
`armlink.loop.process`, which makes the cycles."""


def cause_of(error: BaseException | None) -> EndCause:
    """Why the work ends, by the exception that left it."""
    match error:
        case None:
            return EndCause.DONE
        case KeyboardInterrupt():
            return EndCause.INTERRUPTED
        case Stall():
            return EndCause.STALLED
        case BusFault():
            return EndCause.FAULT
        case Refused():
            return EndCause.REFUSED
    return EndCause.FAILED


def end_work(link: StowableArm, cause: EndCause, tell: Tell) -> None:
    """Bring an arm to its end; raises nothing. `tell` may raise Dropped: the arm is then let go at once."""
    if not (link.enabled or link.held):
        return
    response = ENDS[cause][link.falls]
    link.stop()
    if response is Response.LET_GO:
        link.let_go()
    if response is not Response.PARK:
        return
    try:
        _stow(link, tell)
    except Dropped:
        end_work(link, EndCause.DROPPED, tell)
    except BusFault as fault:
        link.let_go()
        with suppress(Dropped):
            tell(f"the arm could not be parked ({fault}): the drives switch their power off, so the arm may fall")


def _stow(link: StowableArm, tell: Tell) -> None:
    """Park or let down, and take the power."""
    try:
        why = _not_parked(link, tell)
    except (Dropped, BusFault):
        raise
    except Exception as error:  # an error of this program's own is no reason to drop the arm
        why = f"{type(error).__name__}: {error}"
    if why:
        _catch(link)
        let_down(link, tell, why)


def _not_parked(link: StowableArm, tell: Tell) -> str:
    """Park; why that is not possible, empty where it was."""
    if link.section.park is None:
        return "the arm file has no link.park"
    why = ""
    for _ in range(2):  # a joint that fell and was caught on the way has a new way from there
        _catch(link)
        try:
            park(link, tell)
            return ""
        except Refused as blocked:
            why = str(blocked)
    return why


def _catch(link: StowableArm) -> None:
    """Hold the joints, those included that were let go: within what a walk to power takes at most, or not at all."""
    for _ in range(cycle_count(link, ENABLE_SECONDS)):
        link.keep()
        if all(link.commander.held):
            break
