"""Signals that end a program: all leave by the way of Ctrl-C, and none cuts short what makes an arm safe."""

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

ENDING = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Signals that end a program as Ctrl-C (SIGINT) does."""
TWICE_SECONDS = 2.0
"""Two presses of Ctrl-C within this time let the arm go [s]."""
log = logging.getLogger("armlink")


class Dropped(Exception):
    """A person wants the arm to be let go at once."""


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Within this context the signals of ENDING raise KeyboardInterrupt in the main thread, as Ctrl-C does.

    One that is ignored, as under nohup, stays ignored.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in ENDING}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Presses:
    """Within this context signals do not raise: presses of Ctrl-C are counted, and the other ones wait for the end."""

    def __init__(self) -> None:
        self.dropped = False
        """Whether Ctrl-C was pressed twice within TWICE_SECONDS."""
        self._pressed_at = float("-inf")
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Take the signals over; in the main thread alone, since others get none."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *ENDING):
                self._before[number] = signal.signal(number, self._signalled)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def press(self) -> None:
        now = time.monotonic()
        self.dropped = self.dropped or now - self._pressed_at <= TWICE_SECONDS
        self._pressed_at = now
        if not self.dropped:
            log.warning(
                "the arm is brought to rest; pressing Ctrl-C again within %g s lets the arm fall", TWICE_SECONDS
            )

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            self.press()


def end_logger(name: str, presses: Presses, level: int = logging.WARNING) -> Callable[[str], None]:
    """Log the end of an arm, once for each phase; raises Dropped where a person pressed twice.

    A text begins with its phase, up to a comma; an empty one only asks whether to go on.
    """
    phases: set[str] = set()

    def tell(text: str) -> None:
        if presses.dropped:
            raise Dropped
        phase = text.partition(",")[0]
        if phase and phase not in phases:
            phases.add(phase)
            log.log(level, "%s: %s", name, text)

    return tell
