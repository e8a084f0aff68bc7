"""Real time on Linux for a process that keeps a cycle: locked memory, SCHED_FIFO, a garbage collector at rest."""

import ctypes
import gc
import os
from dataclasses import dataclass

PRIORITY = 20
"""Of SCHED_FIFO: above everything ordinary, below the kernel's own threads (50)."""
SIMULATED_PRIORITY = 10
"""Of a simulated arm, which must leave its host the first place."""
_LOCK_CURRENT, _LOCK_FUTURE = 1, 2


@dataclass(frozen=True)
class Realtime:
    """Real-time permissions of this process."""

    scheduled: bool
    """SCHED_FIFO."""
    locked: bool
    """All memory stays in RAM."""

    def __str__(self) -> str:
        """In words, with the remedy for what was not permitted."""
        if self.scheduled and self.locked:
            return "real-time scheduling, memory locked"
        missing = [name for name, got in (("rtprio", self.scheduled), ("memlock", self.locked)) if not got]
        return (
            f"ordinary scheduling, without permission for {' and '.join(missing)} (run as root, or raise the limits in "
            "/etc/security/limits.conf)"
        )


def prepare(priority: int = PRIORITY) -> Realtime:
    """Make this process ready to keep a cycle. Never fails: says what was permitted."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 50, 100)
    return Realtime(_schedule(priority), _lock_memory())


def _schedule(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        return False
    return True


def _lock_memory() -> bool:
    try:
        return bool(ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_CURRENT | _LOCK_FUTURE) == 0)
    except (AttributeError, OSError):
        return False
