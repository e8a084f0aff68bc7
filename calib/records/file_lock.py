"""Exclusive use of a file or directory by one process: an advisory lock that ends with the process."""

import fcntl
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from armlink.bus.arm_hold import program_of
from armlink.errors import BadInput

RETRY_SECONDS = 0.05
"""Time from one attempt to the next [s]."""


def lock_file(descriptor: int, what: str, patience: float = 0.0) -> None:
    """Lock an open file until it is closed; raises BadInput, with who has it, where that takes longer than `patience`.

    `what` names it in the message; `patience` is in seconds.
    """
    end = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= end:
                raise BadInput(
                    f"{what}: in use by {_holder(descriptor)}: stop that process, or choose another one"
                ) from None
            time.sleep(RETRY_SECONDS)


@contextmanager
def locked_directory(path: Path, what: str, patience: float = 0.0) -> Iterator[int]:
    """Exclusive use of a directory, by a file `lock` in it; raises BadInput as `lock_file`.

    Yields its descriptor: a process that inherits it holds the lock as well.
    """
    try:
        descriptor = os.open(path / "lock", os.O_RDWR | os.O_CREAT, 0o640)
    except OSError as error:
        raise BadInput(f"{what}: cannot be locked: {error.strerror}") from None
    try:
        lock_file(descriptor, what, patience)
        yield descriptor
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    """Process that holds a lock on this file, in words, by /proc/locks."""
    inode = os.fstat(descriptor).st_ino
    try:
        locks = Path("/proc/locks").read_text(encoding="ascii")
    except OSError:
        return "another process"
    found = re.search(rf"FLOCK\s+ADVISORY\s+WRITE\s+(\d+)\s+\S+:{inode}\s", locks)
    return "another process" if found is None else f"{program_of(int(found[1]))} (process {found[1]})"
