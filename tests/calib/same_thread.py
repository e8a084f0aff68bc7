"""The daemon's work for bus and disk in the thread that asks for it, so that a test goes step by step."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from calib.daemon.state.journal import Journal

T = TypeVar("T")


class Immediate:
    """`Worker` for one thread alone: work is done, and its outcome given, before the call returns."""

    def __call__(self, work: Callable[[], T], done: Callable[[T | Exception], None]) -> None:
        try:
            outcome: T | Exception = work()
        except Exception as error:
            outcome = error
        done(outcome)

    def drain(self, seconds: float, /) -> bool:
        return True


def journal_at(path: Path, monotonic: Callable[[], float] = time.monotonic) -> Journal:
    """A journal that is on disk at once."""
    return Journal(path, monotonic, Immediate())
