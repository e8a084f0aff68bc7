"""The surroundings that the service is given: clocks, threads for work that waits for bus or disk, the bus loop."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

from armlink.errors import ArmlinkError
from armlink.link.types import Controller, Controllers

T = TypeVar("T")
CLOSING_SECONDS = 2.0
"""Time that each of the threads, and the clients of the web part, have at the end [s]."""
RETRY_SECONDS = 1.0
"""Time from a failure of a disk or a database to the next attempt [s]."""


class Worker:
    """Does work that waits in one thread, in its order; the outcomes come back on the event loop in the same order.

    The thread ends with the process: work that never returns keeps nobody from ending.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, name: str, do: Callable[[Callable[[], Any]], Any] = lambda work: work()
    ) -> None:
        """`do` is what the thread does with a piece of work."""
        self._loop, self._do = loop, do
        self._work = SimpleQueue[tuple[Callable[[], Any], Callable[[Any], None]]]()
        self._outcomes = deque[Callable[[], None]]()
        self._unfinished = 0
        """Work that was given and whose outcome was not."""
        self._finished = threading.Condition()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Have `work` done, then call `done` with its value or the error it raised. Returns at once; for the loop's
        thread only."""
        self._unfinished += 1
        self._work.put((work, done))

    def drain(self, seconds: float) -> bool:
        """Wait until all work is done, at most so long [s]; whether it is. For the loop's thread, at its end."""
        end = time.monotonic() + seconds
        while self._unfinished:
            with self._finished:
                if not self._finished.wait_for(lambda: self._outcomes, max(0.0, end - time.monotonic())):
                    return False
            self._deliver()
        return True

    def _run(self) -> None:
        while True:
            work, done = self._work.get()
            try:
                outcome: Any = self._do(work)
            except Exception as error:
                outcome = error
            with self._finished:
                self._outcomes.append(lambda done=done, outcome=outcome: done(outcome))  # type: ignore[misc]
                self._finished.notify()
            del work, done, outcome  # nothing is held while the thread waits
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        while self._outcomes:
            self._unfinished -= 1
            self._outcomes.popleft()()


class BusAccess(Protocol):
    @property
    def controllers(self) -> Controllers:
        """Reads and writes the calibration of every joint; waits for the answer, so only for work that runs aside."""

    def move(self, controller: Controller, /) -> None:
        """Have a controller run; Stopped comes where that is not possible, Progress where it tells that."""


@dataclass(frozen=True)
class Environment:
    """Injected by the main loop; tests have their own."""

    monotonic: Callable[[], float]
    """[s]"""
    wall: Callable[[], datetime]
    """With time zone."""
    run: Worker
    """For bus and record store."""
    port: BusAccess
    disk: Worker
    """For all work on the state directory but the diagnosis of the day, which has a thread and a folder of its own."""
    aside: Worker
    """For work that takes seconds and can be pickled."""


class BusJobs:
    """`busy` while a job is under way; the calibration in the controllers may change during that time."""

    def __init__(self, run: Worker) -> None:
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
