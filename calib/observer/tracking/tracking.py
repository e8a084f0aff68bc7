"""Tracking of every joint's sensor row by row: noise, filtered gain and offset, change detection."""

from copy import copy
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.cause_test import CauseTest
from calib.observer.config import ObserverConfig
from calib.observer.decision import Finding
from calib.observer.effect_dictionary import Window
from calib.observer.gravity_belief import GravityBelief
from calib.observer.saved_values import UNREADABLE
from calib.observer.tracking.cusum import Cusum
from calib.observer.tracking.pose_memory import PoseMemory
from calib.observer.tracking.sensor_filter import SensorFilter
from gcomp.arrays import Array, as_array

Alarm = tuple[str, int, dict[str, Any]]
"""Kind (alarm or outliers), joint, evidence."""


class Tracking:
    """The gravity model as it is believed, and every joint's sensor against it. Rows have true-angle positions."""

    def __init__(self, belief: GravityBelief, sigma: Array, config: ObserverConfig) -> None:
        """sigma (n,) [N·m]: standard deviation of one row's torque to begin with, replaced by the measured one."""
        n = belief.arm.n
        self.belief, self.sigma, self._config = belief, np.asarray(sigma, dtype=float), config
        self.rows = 0
        """Rows taken."""
        self.filter = SensorFilter(n, config)
        self._cusum = Cusum(n, config)
        self._poses = PoseMemory(n, config)

    def count(self, row: StaticReading) -> None:
        """Count a row, and average its measured noise into sigma."""
        self.rows += 1
        if np.isfinite(row.torque_error).all():
            weight = 1 / min(self.rows + self._config.noise_rows, self._config.noise_memory)
            self.sigma = np.sqrt((1 - weight) * self.sigma**2 + weight * row.torque_error**2)

    def watch(self, row: StaticReading) -> list[Alarm]:
        """Take a row while no alarm is open: update the filter unless the row raises an alarm."""
        q, noise = row.position, self.sigma**2
        torque = self.belief.torque(q[None])[0]
        of_model = self.belief.torque_variance(q, self._config.position_std)
        expected, left = self._poses.expected(q, of_model, noise)
        alarms = self._cusum.handle(row.torque - torque - expected, torque, noise + left)
        if alarms:
            return [("alarm", joint, {"channel": channel}) for joint, channel in alarms]
        if self._poses.seen(q) < self._config.place_rows:
            self.filter.handle(row.torque, torque, noise + of_model)
        self._poses.add(q, row.torque - torque)
        most = self._config.outliers_in_a_row
        return [("outliers", int(joint), {"rows": most}) for joint in np.flatnonzero(self.filter.rejected >= most)]

    def cause_test(self, rows: list[StaticReading]) -> CauseTest:
        """The cause test of these rows, by the present belief."""
        return CauseTest(self.belief, Window.of(rows), self.sigma, self._config)

    def learn(self, rows: list[StaticReading]) -> None:
        """Adapt the model to rows that are free of drift."""
        window = Window.of(rows)
        self.belief.learn(window.position, window.torque, self.sigma)
        self._poses.forget()

    def carry(self, values: Array, covariance: Array) -> None:
        """Add a tool to the model: mass and first moment (4,), covariance (4, 4)."""
        self.belief.carry(values, covariance)
        self._poses.forget()

    def install(self, finding: Finding) -> None:
        """The finding was written: its joint is as installed, within the finding's uncertainty."""
        floor = np.diag([self._config.drift_gain**2, self._config.drift_offset**2])
        self.filter.restart(finding.joint, covariance=finding.covariance + floor)
        self._poses.forget()

    def resume(self) -> None:
        """The alarm is closed: change detection starts from zero."""
        self._cusum.reset()

    def save(self) -> dict[str, Any]:
        """All parts as JSON values."""
        own: dict[str, Any] = {"sigma": self.sigma.tolist(), "rows": self.rows}
        return own | self.belief.save() | self.filter.save() | self._cusum.save() | self._poses.save()

    def restore(self, values: dict[str, Any]) -> bool:
        """Continue from saved values; False, and nothing changed, if they do not fit."""
        belief, sensors = copy(self.belief), copy(self.filter)
        cusum, poses = copy(self._cusum), copy(self._poses)
        try:
            sigma, rows = as_array("sigma", values["sigma"], self.sigma.shape), int(values["rows"])
        except UNREADABLE:
            return False
        fits = belief.restore(values) and sensors.restore(values) and cusum.restore(values) and poses.restore(values)
        if not fits:
            return False
        self.sigma, self.rows = sigma, rows
        self.belief, self.filter, self._cusum, self._poses = belief, sensors, cusum, poses
        return True
