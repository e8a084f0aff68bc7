"""Keeps the observer's state and its history on disk."""

from datetime import timedelta

from calib.daemon.environment import Environment
from calib.daemon.observation.observer_feed import ObserverFeed
from calib.daemon.state.journal import Journal
from calib.observer.decision import DriftFinding

SAVE_SECONDS = 5.0
"""The observer's state is saved this often while there is something new [s]: what a kill may lose, about two stops."""
HISTORY_SECONDS = 60.0
"""Time between points of history [s]; each event adds one too."""
HISTORY_WHOLE = timedelta(days=30)
"""Points of history older than this are thinned."""
THINNING_FACTOR = 10
"""One of this many older points is kept."""
THINNING_SECONDS = 86400.0
"""Time between two thinnings [s]."""


class ObserverStorage:
    """Saves and restores an observer, and appends its estimates to the history."""

    def __init__(self, journal: Journal, environment: Environment) -> None:
        self._journal, self._environment = journal, environment
        self._rows = 0
        self._saved_at = self._history_at = self._thinned_at = -float("inf")

    def tick(self, feed: ObserverFeed | None) -> None:
        now = self._environment.monotonic()
        if now - self._thinned_at >= THINNING_SECONDS:
            self._journal.thin_history(self._environment.wall() - HISTORY_WHOLE, THINNING_FACTOR)
            self._thinned_at = now
        if feed is None or feed.observer.rows == self._rows or self._journal.waiting:
            return
        due = now - self._history_at >= HISTORY_SECONDS
        if due or now - self._saved_at >= SAVE_SECONDS:
            self.save(feed, history=due)

    def save(self, feed: ObserverFeed, history: bool = False) -> None:
        """Save the observer's state and, if asked for, a point of history: both or neither."""
        now, t = self._environment.wall(), self._environment.monotonic()
        with self._journal.transaction():
            self._journal.save_belief(now, feed.calibration.id, feed.gravity.id, feed.observer.save())
            if history:
                self._journal.add_history(now, t, feed.calibration.id, feed.point())
                self._history_at = t
        self._saved_at, self._rows = t, feed.observer.rows

    def restore(self, feed: ObserverFeed, installed: DriftFinding | None) -> None:
        """Continue a new feed's observer from the saved state if that belongs to the same records.

        It may also belong to the record before, if `installed`, a finding that the state lacks, led from there to here.
        """
        saved = self._journal.belief()
        if saved is None or saved.gravity != feed.gravity.id:
            return
        if saved.calibration == feed.calibration.id:
            feed.observer.restore(saved.state)
        elif saved.calibration == feed.calibration.parent and installed and feed.observer.restore(saved.state):
            feed.observer.install(installed)
