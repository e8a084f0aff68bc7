"""Work that waits for bus or record store: one job at a time, outside of the service's thread."""

from collections.abc import Callable
from typing import TypeVar

from armlink.errors import ArmlinkError
from calib.daemon.environment import RunAside

T = TypeVar("T")


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
