"""The observer of a pair of records, between bus loop and journal: fed, and kept on disk."""

from datetime import datetime, timedelta

import numpy as np

from armlink.arm_file import ArmFile
from armlink.loop.messages import Batch
from armlink.torque_calibration import UNCALIBRATED, Calibration, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.daemon.environment import Environment
from calib.daemon.observation.recalibration_workflow import DAY, Samples
from calib.daemon.state.journal import Journal
from calib.observer.config import ObserverConfig
from calib.observer.decision import DriftFinding, Event
from calib.observer.observer import observer_of
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arrays import Array

OBSERVED_RATE = 50.0
"""Samples per second that the observer gets, each the mean of those in between [Hz]: a rest is averaged over 0.3 s
(`ObserverConfig.average_time`), 15 samples."""
SAVE_SECONDS = 5.0
"""The observer's state is saved this often while there is something new [s]: what a kill may lose, about two stops."""
HISTORY_SECONDS = 60.0
"""Time between points of history [s]; each event adds one too."""
HISTORY_WHOLE = timedelta(days=30)
"""Points of history older than this are thinned."""
THINNING_FACTOR = 10
"""One of this many older points is kept."""


class ObserverFeed:
    def __init__(
        self, arm: ArmFile, calibration: CalibrationRecord, gravity: GravityRecord, config: ObserverConfig
    ) -> None:
        """Raises Refused if a record is of another arm."""
        section = arm.require_link()
        described, self.gravity, self.calibration = gcomp_arm(arm), gravity.require(arm), calibration.require(arm)
        self.carried = gravity.carrying(arm)
        """The gravity record with the tool of now."""
        self.names = described.names
        rated = section.rated_torques
        self.observer = observer_of(described, self.calibration, self.carried, rated, config)
        self._group = max(1, round(section.rate / OBSERVED_RATE))
        self._change = per_joint([UNCALIBRATED] * described.n)
        self._left: Samples | None = None
        self.last_accepted: dict[str, datetime] = {}
        """Time of the newest row that went into each joint's estimate."""

    def measures_against(self, calibration: CalibrationRecord, gravity: GravityRecord, arm: ArmFile) -> bool:
        return (calibration.id, gravity.carrying(arm).id) == (self.calibration.id, self.carried.id)

    def install(self, record: CalibrationRecord, finding: DriftFinding) -> None:
        """A finding was written: `record`, which follows from the one before, is in force and in the controllers."""
        self.calibration = record
        self.controllers_hold(None)
        self.observer.install(finding)

    def controllers_hold(self, held: tuple[Calibration, ...] | None) -> list[str]:
        """Convert readings from what the controllers hold to the record in force.

        Returns the joints that hold another pair than the record's; none if it is not known (None).
        """
        if held is None:
            self._change = per_joint([UNCALIBRATED] * len(self.names))
            return []
        installed = per_joint(held)
        wanted = self.calibration.torque_calibration(installed)
        same = np.isclose(installed.gain, wanted.gain, rtol=1e-6, atol=0)
        differ = ~(same & np.isclose(installed.offset, wanted.offset, atol=1e-6))
        change = installed.relative_to(wanted)
        self._change = TorqueCalibration(np.where(differ, change.gain, 1.0), np.where(differ, change.offset, 0.0))
        return [name for name, other in zip(self.names, differ, strict=True) if other]

    def reading(self, torque: Array) -> Array:
        """Torque (…, n) [N·m] as sent, converted to the record in force."""
        return self._change.apply(torque)

    def decimate(self, batch: Batch) -> Samples:
        """The samples of a batch at the observer's rate; NaN if all that go into one are missing."""
        columns = (batch.t, batch.channels["position"], self.reading(batch.channels["torque"]))
        if self._left is not None:
            columns = tuple(np.concatenate(pair) for pair in zip(self._left, columns, strict=True))  # type: ignore[assignment]
        whole = len(columns[0]) // self._group * self._group
        self._left = tuple(column[whole:] for column in columns)  # type: ignore[assignment]
        t, position, torque = (column[:whole] for column in columns)
        n = len(self.names)
        return (
            t.reshape(-1, self._group).mean(axis=1),
            _mean(position.reshape(-1, self._group, n)),
            _mean(torque.reshape(-1, self._group, n)),
        )

    def observe(self, samples: Samples, temperature: Array | None, now: datetime) -> list[Event]:
        """Give decimated samples, and the drives' temperatures (n,) [°C] meanwhile, to the observer: its events."""
        events, before = list[Event](), self.observer.accepted
        for t, position, torque in zip(*samples, strict=True):
            events += self.observer.handle(float(t), position, torque, temperature)
        self.last_accepted |= {self.names[j]: now for j in np.flatnonzero(self.observer.accepted > before)}
        return events


def _mean(groups: Array) -> Array:
    """Mean over axis 1 of the readings that are not missing; NaN if all are."""
    there = ~np.isnan(groups)
    count = there.sum(axis=1)
    total = np.where(there, groups, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


class ObserverStorage:
    """Saves and restores an observer, and appends its estimates to the history."""

    def __init__(self, journal: Journal, environment: Environment) -> None:
        self._journal, self._environment = journal, environment
        self._rows = 0
        self._saved_at = self._history_at = self._thinned_at = -float("inf")

    def tick(self, feed: ObserverFeed | None) -> None:
        now = self._environment.monotonic()
        if now - self._thinned_at >= DAY:
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
            self._journal.save_belief(now, feed.calibration.id, feed.carried.id, feed.observer.save())
            if history:
                self._journal.add_history(now, t, feed.calibration.id, feed.observer.estimate().as_json())
                self._history_at = t
        self._saved_at, self._rows = t, feed.observer.rows

    def restore(self, feed: ObserverFeed, installed: DriftFinding | None) -> None:
        """Continue a new feed's observer from the saved state if that belongs to the same records.

        It may also belong to the record before, if `installed`, a finding that the state lacks, led from there to here.
        """
        saved = self._journal.belief()
        if saved is None or saved.gravity != feed.carried.id:
            return
        if saved.calibration == feed.calibration.id:
            feed.observer.restore(saved.state)
        elif saved.calibration == feed.calibration.parent and installed and feed.observer.restore(saved.state):
            feed.observer.install(installed)
