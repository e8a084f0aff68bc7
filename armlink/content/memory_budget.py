"""Memory that reading a file from outside may take, whatever its format unpacks to and whoever's code reads it.

Sizes that a file states are asked before it is read; this bounds what no header states, or states wrongly. The kernel
refuses what goes beyond (RLIMIT_DATA, which counts a process's private writable pages), and that is bad input.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from armlink.errors import BadInput

LEAST_BUDGET = 1 << 30
"""Budget of a small file [bytes]: an hour of seven joints with four channels at 1 kHz takes 0.8 GB."""
MOST_BUDGET = 8 << 30
"""Budget of any file [bytes]: a recording of 2 GiB as text, as columns and as arrays, with its copies."""
BUDGET_RATIO = 100
"""Budget of a file over its size: gzip makes 7 to 20 bytes of numbers in text one, and a number of two characters
takes eight bytes in each of three copies."""
_LOCK = threading.RLock()


@contextmanager
def memory_budget(path: Path) -> Iterator[None]:
    """Within the block at most the budget of this file or folder is allocated; raises BadInput beyond it.

    Blocks of several threads wait for one another. Without Linux's /proc there is no bound.
    """
    budget = min(max(BUDGET_RATIO * _size_on_disk(path), LEAST_BUDGET), MOST_BUDGET)
    try:
        with _LOCK, _at_most(budget):
            yield
    except MemoryError:
        raise BadInput(
            f"{path}: reading it would take more than {budget / 1e9:.1f} GB of memory, which this program "
            "does not allow"
        ) from None


def _size_on_disk(path: Path) -> int:
    """Bytes of a file, or of the files in a folder and below."""
    try:
        if not path.is_dir():
            return path.stat().st_size
        return sum(each.stat().st_size for each in path.rglob("*") if each.is_file())
    except OSError:
        return 0


@contextmanager
def _at_most(budget: int) -> Iterator[None]:
    used = _data_size()
    if used is None:
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = used + budget
    bounds = [each for each in (wanted, soft, hard) if each != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _data_size() -> int | None:
    """Private writable pages of this process [bytes]; None where the system does not tell."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[5]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None
