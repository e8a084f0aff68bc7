"""A thread for work that may have to wait, on a disk, a database or the bus: the event loop never does."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, TypeVar

T = TypeVar("T")


class Worker:
    """`RunAside` of an event loop: work in its order in one thread, the outcomes back on the loop in the same order.

    The thread ends with the process: work that never returns keeps nobody from ending.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, name: str) -> None:
        self._loop = loop
        self._work = SimpleQueue[tuple[Callable[[], Any], Callable[[Any], None]]]()
        self._outcomes = deque[Callable[[], None]]()
        self._unfinished = 0
        """Work that was given and whose outcome was not."""
        self._finished = threading.Condition()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        """Returns at once; for the loop's thread only."""
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
                outcome: Any = work()
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
