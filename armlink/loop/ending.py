"""How a process that makes the cycles ends: when its job goes, not when a signal reaches the whole group."""

import signal
import time
from types import FrameType

GRACE = 2.0
"""After SIGTERM the job has this long to end this process [s]."""


class Ending:
    """SIGINT and SIGTERM are left to the job, which gets them too: it closes its end, and says how it ended.

    A job that does not within GRACE after SIGTERM hangs, and this process then ends by itself.
    """

    def __init__(self) -> None:
        """Take over the signals of this process."""
        self._asked: float | None = None
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, self._note)

    @property
    def due(self) -> bool:
        """Whether to end although the job is still there."""
        return self._asked is not None and time.monotonic() - self._asked > GRACE

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._asked is None:
            self._asked = time.monotonic()
