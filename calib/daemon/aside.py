"""A calculation that takes seconds, in a process of its own at low priority: neither service nor cycle waits for it."""

import os
import sys
from collections.abc import Callable
from typing import TypeVar

from armlink.channel import Closed, channel_of, start_process
from armlink.errors import Refused
from armlink.loop.ending import HANG_SECONDS

T = TypeVar("T")
NICE = 10
"""Niceness of such processes."""


def in_process(work: Callable[[], T]) -> T:
    """Do `work`, which can be pickled, and wait for its value; raises its errors, or Refused if it is killed."""
    process, channel = start_process(("-m", __name__))
    try:
        channel.put(work)
        channel.flush(HANG_SECONDS)
        outcome: T | Exception = channel.first()
    except Closed:
        raise Refused(f"the process that calculates ended with status {process.wait()}: try again") from None
    finally:
        channel.close()
        process.wait()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _main(descriptor: int) -> None:
    os.nice(NICE)
    channel = channel_of(descriptor)
    try:
        outcome = channel.first()()
    except Exception as error:
        outcome = error
    channel.put(outcome)
    channel.flush(HANG_SECONDS)


if __name__ == "__main__":
    _main(int(sys.argv[1]))
