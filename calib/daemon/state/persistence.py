"""When what the observer has learnt goes to disk, and how long its history stays there in full."""

from datetime import timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.daemon.service import Service

BELIEF_SECONDS = 5.0
"""The observer's belief is kept at least so often while there is something new."""
HISTORY_SECONDS = 60.0
"""One point of history in this time, and one at each event."""
HISTORY_WHOLE = timedelta(days=30)
"""Points of history older than this are thinned."""
THINNED = 10
"""Of those one in so many stays."""
THIN_SECONDS = 86400.0
"""Looked after so often."""


class Keeping:
    """Belief and history of a service's observer."""

    def __init__(self, service: "Service") -> None:
        self._service = service
        self._rows = 0
        self._kept_at = self._history_at = self._thinned_at = -float("inf")

    def tick(self, now: float) -> None:
        """Keep what is due at this monotonic time [s]."""
        service = self._service
        if now - self._thinned_at >= THIN_SECONDS:
            service.journal.thin_history(service.around.wall() - HISTORY_WHOLE, THINNED)
            self._thinned_at = now
        if service.watcher is None or service.watcher.observer.rows == self._rows:
            return
        due = now - self._history_at >= HISTORY_SECONDS
        if due or now - self._kept_at >= BELIEF_SECONDS:
            self.keep(history=due)

    def keep(self, history: bool = False) -> None:
        """Put the observer's belief on disk, and a point of history where asked for, both or neither."""
        service, watcher = self._service, self._service.watcher
        if watcher is None:
            return
        now, t = service.around.wall(), service.around.monotonic()
        calibration, gravity = watcher.calibration.id, watcher.gravity.id
        with service.journal.transaction():
            service.journal.save_belief(now, calibration, gravity, watcher.save())
            if history:
                service.journal.add_history(now, t, calibration, watcher.point())
                self._history_at = t
        self._kept_at, self._rows, service.trouble = t, watcher.observer.rows, ""
