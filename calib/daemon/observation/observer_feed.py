"""Between bus loop and observer: batches decimated, readings converted to the calibration of the record in force."""

import numpy as np

from armlink.arm_file import ArmFile
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.daemon.loop.loop_messages import Batch
from calib.observer.config import ObserverConfig
from calib.observer.decision import DriftFinding
from calib.observer.events import Event
from calib.observer.observer import observer_of
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arrays import Array

OBSERVED_RATE = 50.0
"""Samples per second that the observer gets, each the mean of those in between [Hz]: a rest is averaged over 0.3 s
(`ObserverConfig.average_time`), 15 samples."""

Samples = tuple[Array, Array, Array]
"""t (K,) [s], position (K, n) [rad], torque (K, n) [N·m]."""


class ObserverFeed:
    """An observer with the records that it measures against."""

    def __init__(
        self, arm: ArmFile, calibration: CalibrationRecord, gravity: GravityRecord, config: ObserverConfig
    ) -> None:
        """Raises Refused if a record is of another arm."""
        section = arm.require_link()
        described, self.gravity, self.calibration = gcomp_arm(arm), gravity.require(arm), calibration.require(arm)
        self.names = described.names
        rated = section.rated_torques
        self.observer = observer_of(described, self.calibration, self.gravity, rated, config)
        self._group = max(1, round(section.rate / OBSERVED_RATE))
        self._change = per_joint([UNCALIBRATED] * described.n)
        self._left: Samples | None = None

    def measures_against(self, calibration: CalibrationRecord, gravity: GravityRecord) -> bool:
        return (calibration.id, gravity.id) == (self.calibration.id, self.gravity.id)

    def install(self, record: CalibrationRecord, finding: DriftFinding) -> None:
        """A finding was written: `record`, which follows from the one before, is in force and in the controllers."""
        self.calibration = record
        self.controllers_hold(None)
        self.observer.install(finding)

    def controllers_hold(self, held: tuple[tuple[float, float, int], ...] | None) -> list[str]:
        """Convert readings from what the controllers hold (gain, offset, record id) to the record in force.

        Returns the joints that hold another pair than the record's; none if it is not known (None).
        """
        if held is None:
            self._change = per_joint([UNCALIBRATED] * len(self.names))
            return []
        installed = per_joint(TorqueCalibration(gain, offset) for gain, offset, _ in held)
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

    def observe(self, samples: Samples, temperature: Array | None = None) -> list[Event]:
        """Give decimated samples, and the drives' temperatures (n,) [°C] meanwhile, to the observer: its events."""
        events: list[Event] = []
        for t, position, torque in zip(*samples, strict=True):
            events += self.observer.handle(float(t), position, torque, temperature)
        return events

    def point(self) -> dict[str, list[float]]:
        """A point of history: gain, offset [N·m] and their standard deviations, one value per joint."""
        estimate = self.observer.estimate()
        return {name: getattr(estimate, name).tolist() for name in ("gain", "gain_std", "offset", "offset_std")}


def _mean(groups: Array) -> Array:
    """Mean over axis 1 of the readings that are not missing; NaN if all are."""
    there = ~np.isnan(groups)
    count = there.sum(axis=1)
    total = np.where(there, groups, 0.0).sum(axis=1)
    mean: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean
