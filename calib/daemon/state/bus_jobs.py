"""Work that waits for the bus: one job at a time, outside of the service's thread."""

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

from armlink.errors import ArmlinkError
from calib.daemon.environment import RunAside
from calib.daemon.state.journal import Journal

T = TypeVar("T")


class BusJobs:
    """`busy` while a job is under way; the calibration in the controllers may change during that time."""

    def __init__(self, run: RunAside, journal: Journal) -> None:
        self.busy = False
        self._run, self._journal = run, journal

    def start(self, work: Callable[[], T], done: Callable[[T | ArmlinkError], None]) -> None:
        """Run `work` aside, then call `done` with its value or its ArmlinkError; any other error is raised."""

        def back(outcome: T | Exception) -> None:
            self.busy = False
            self._finish(outcome, done)

        assert not self.busy
        self.busy = True
        self._run(work, back)

    def aside(self, work: Callable[[], T], done: Callable[[T | ArmlinkError], None]) -> None:
        """As `start`, for work that leaves the controllers alone: `busy` stays what it is."""

        self._run(work, lambda outcome: self._finish(outcome, done))

    def _finish(self, outcome: T | Exception, done: Callable[[T | ArmlinkError], None]) -> None:
        def finish() -> None:
            if isinstance(outcome, Exception) and not isinstance(outcome, ArmlinkError):
                raise outcome
            done(outcome)

        self._journal.guard(finish)


class InThread:
    """`RunAside` of an event loop: work in a thread, its outcome back on the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._tasks: set[asyncio.Future[Any]] = set()

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Returns at once."""

        def back(future: asyncio.Future[T]) -> None:
            self._tasks.discard(future)
            if future.cancelled():
                return
            error = future.exception()
            done(error if isinstance(error, Exception) else future.result())

        future = self._loop.run_in_executor(None, work)
        self._tasks.add(future)
        future.add_done_callback(back)
