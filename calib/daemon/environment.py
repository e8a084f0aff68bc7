"""The surroundings that the service is given: clocks, threads for work that waits for bus or disk, the bus loop."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Protocol, TypeVar

from armlink.errors import ArmlinkError
from armlink.loop.messages import LoopAnswer
from calib.install.journaled_write import Controllers

T = TypeVar("T")


class RunAside(Protocol):
    """Runs work that waits in another thread, in the order in which it is given."""

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Call `done` on the service's own thread with the value that `work` returned, or the error it raised."""
        ...


class Disk(RunAside, Protocol):
    """Likewise all work on the state directory: the only thread that writes there."""

    def drain(self, seconds: float, /) -> bool:
        """Wait until all work is done, at most so long [s]; whether it is."""
        ...


class Immediate:
    """`Disk` for one thread alone: work is done, and its outcome given, before the call returns."""

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        try:
            outcome: T | Exception = work()
        except Exception as error:
            outcome = error
        done(outcome)

    def drain(self, seconds: float, /) -> bool:
        return True


class BusAccess(Protocol):
    """Access to the bus loop."""

    @property
    def controllers(self) -> Controllers:
        """Reads and writes the calibration of every joint; waits for the answer, so only for work that runs aside."""
        ...

    def sweep(self, poses: int, seed: int, /) -> LoopAnswer | None:
        """Ask for a tour of poses; the reply comes as a message unless it is returned."""
        ...


@dataclass(frozen=True)
class Environment:
    """Injected by the main loop; tests have their own."""

    monotonic: Callable[[], float]
    """[s]"""
    wall: Callable[[], datetime]
    """With time zone."""
    run: RunAside
    """For bus and record store."""
    port: BusAccess
    disk: Disk = field(default_factory=Immediate)


class BusJobs:
    """`busy` while a job is under way; the calibration in the controllers may change during that time."""

    def __init__(self, run: RunAside) -> None:
        self.busy = False
        self._run = run

    def start(self, work: Callable[[], T], done: Callable[[T | ArmlinkError], None]) -> None:
        """Run `work` aside, then call `done` with its value or its ArmlinkError; any other error is raised."""

        def back(outcome: T | Exception) -> None:
            self.busy = False
            _finish(outcome, done)

        assert not self.busy
        self.busy = True
        self._run(work, back)

    def aside(self, work: Callable[[], T], done: Callable[[T | ArmlinkError], None]) -> None:
        """As `start`, for work that leaves the controllers alone: `busy` stays what it is."""
        self._run(work, lambda outcome: _finish(outcome, done))


def _finish(outcome: T | Exception, done: Callable[[T | ArmlinkError], None]) -> None:
    if isinstance(outcome, Exception) and not isinstance(outcome, ArmlinkError):
        raise outcome
    done(outcome)
