"""Tracking of every joint's sensor row by row: noise, filtered gain and offset, change detection."""

from collections import deque
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading, batch, stack
from calib.observer.cause_test import CauseTest, DetectionLimits, limits
from calib.observer.config import AUDIT_ROWS, LONGEST_WINDOW, NOISE_ROWS, ObserverConfig
from calib.observer.decision import DriftFinding
from calib.observer.gravity_belief import GravityBelief
from calib.observer.saved_values import read_rows, restored, save_rows
from calib.observer.tracking.cusum import ALARM_THRESHOLD, Cusum
from calib.observer.tracking.pose_memory import PLACE_ROWS, PoseMemory
from calib.observer.tracking.sensor_filter import GAIN_WALK, OFFSET_WALK, OUTLIER, SensorFilter
from gcomp.arrays import Array, as_array
from gcomp.identify.readings import StaticReadings

Alarm = tuple[str, int, dict[str, Any]]
"""Kind (alarm, suspicion or outliers), joint, evidence."""

NOISE_MEMORY = 200
"""Rows that the measured standard deviation is averaged over: known within 5 % by then."""
OUTLIERS_IN_A_ROW = 3
"""This many rejected rows in succession are an event, not outliers (docs/theory.md, section 6)."""
DOUBT = 4.0
"""An alarm is one at once if its log-likelihood ratio is this many times larger than needed, where the model's error is
all there is beside it; else it is first confirmed."""

STEADY, CHANCE = 8.0, 3.0
"""The two halves of a rest's average may differ by this many standard deviations of it, and do by chance at most."""


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
        self._poses = PoseMemory(n)
        self._suspected = 0
        """Rows for which there has been a suspicion: it may yet become an alarm."""
        self._since: deque[tuple[StaticReading, bool]] = deque(maxlen=config.window)

    def count(self, row: StaticReading) -> bool:
        """Count a row, and average its measured noise into sigma; False if its torque was not steady.

        Such a row is not of a rest: a motion begins in it, or a load changes. Sigma grows by what it may at most have
        been by chance, so that rows of an arm that has become noisier count again after a while.
        """
        if not np.isfinite(row.torque_error).all():
            self.rows += 1
            return True
        steady = bool((row.torque_error <= STEADY * self.sigma).all())
        self.rows += steady
        error = np.minimum(row.torque_error, CHANCE * self.sigma)
        weight = 1 / min(self.rows + NOISE_ROWS, NOISE_MEMORY)
        self.sigma = np.sqrt((1 - weight) * self.sigma**2 + weight * error**2)
        return steady

    def watch(self, row: StaticReading) -> list[Alarm]:
        """Take a row while no alarm is open: update the filter unless the row raises an alarm."""
        q, noise = row.position, self.sigma**2
        expected = self.belief.expected(q[None], row.direction[None], row.temperature[None])
        torque, of_model = expected.torque[0], expected.variance[0]
        residual = row.torque - torque - expected.mean[0]
        here, left = self._poses.expected(q, of_model, noise)
        self._since.append((row, self._poses.seen(q) >= PLACE_ROWS))
        if not self.belief.level.is_known:
            return []
        alarms = self._cusum.handle(residual - here, torque, noise + left)
        if alarms and (told := self._judged(alarms)) is not None:
            return told
        if self._poses.seen(q) < PLACE_ROWS:
            self.filter.handle(row.torque - expected.mean[0], torque, noise + of_model)
        self._poses.add(q, residual)
        most = OUTLIERS_IN_A_ROW
        wild = [j for j in np.flatnonzero(self.filter.rejected >= most).tolist() if self._are_outliers(j)]
        return [("outliers", joint, {"rows": most}) for joint in wild]

    def _judged(self, alarms: list[tuple[int, str]]) -> list[Alarm] | None:
        """Alarms of the CUSUM to tell now, none while they are open; None if all were the model's error."""
        found = [(self._seen_as(*alarm), *alarm) for alarm in alarms]
        for kind, joint, channel in found:
            if not kind:
                self._cusum.drop(joint, channel)
        seen = [(kind, joint, {"channel": channel}) for kind, joint, channel in found if kind]
        self._suspected = self._suspected + 1 if seen else 0
        certain = [alarm for alarm in seen if alarm[0] == "alarm"]
        if certain or self._suspected >= AUDIT_ROWS:
            return certain or seen
        return [] if seen else None

    def _recent(self, joint: int, count: int) -> tuple[Array, Array, Array]:
        """Of the last rows (K,): one joint's residual, its model torque, and the covariance (K, K) of the residual."""
        rows = [row for row, _ in self._since][-count:]
        position, torques, side, temperature = _arrays(rows)
        expected = self.belief.expected(position, side, temperature)
        residual = (torques - expected.torque - expected.mean)[:, joint]
        return (
            residual,
            expected.torque[:, joint],
            expected.of_joint(joint) + self.sigma[joint] ** 2 * np.eye(len(rows)),
        )

    def _are_outliers(self, joint: int) -> bool:
        """Whether the rejected rows stand out together; the model's own error is alike at poses close to each other."""
        count = OUTLIERS_IN_A_ROW
        residual, _, covariance = self._recent(joint, count)
        outliers = bool(residual @ np.linalg.solve(covariance, residual) > count * OUTLIER)
        if not outliers:
            self.filter.rejected[joint] = 0
        return outliers

    def _seen_as(self, joint: int, channel: str) -> str:
        """Whether the rows since a channel began to rise show its change beyond the model's own, correlated error.

        "alarm" if they do without doubt, "suspicion" if other rows must confirm it, "" if they do not.
        """
        count = self._cusum.rising(joint, channel)
        known = [known for _, known in self._since][-count:]
        if 2 * sum(known) > len(known):
            return "alarm"  # at places whose error is known
        residual, torque, covariance = self._recent(joint, count)
        change = torque if channel.startswith("gain") else np.ones_like(torque)
        weight = np.linalg.solve(covariance, change)
        of_model = 1 - self.sigma[joint] ** 2 * len(residual) / float(np.trace(covariance))
        shown = float((weight @ residual) ** 2 / (weight @ change)) / (2 * ALARM_THRESHOLD)
        if shown <= 1:
            return ""
        return "alarm" if shown > 1 + DOUBT * of_model else "suspicion"

    def cause_test(self, rows: list[StaticReading]) -> CauseTest:
        """The cause test of these rows, by the belief from rows before them."""
        belief = self.belief.before(rows[0].position)
        return CauseTest(belief, batch(rows, self.sigma), stack(rows, "temperature"))

    def learn(self, rows: list[StaticReading]) -> None:
        """Take rows that are free of drift as reference."""
        if rows:
            position, torque, side, temperature = _arrays(rows)
            self.belief.learn(position, torque, side, self.sigma, temperature)
            self._poses.forget()

    def adapt(self, rows: list[StaticReading]) -> None:
        """Adapt the discrepancy's level to rows whose cause nothing explains."""
        self.belief.adapt(*_arrays(rows)[:3], self.sigma)
        self._poses.forget()

    def carry(self, values: Array, covariance: Array) -> None:
        """Add a tool to the model: mass and first moment (4,), covariance (4, 4)."""
        self.belief.carry(values, covariance)
        self._poses.forget()

    def install(self, finding: DriftFinding) -> None:
        """The finding was written: its joint is as installed, within the finding's uncertainty."""
        floor = np.diag([GAIN_WALK**2, OFFSET_WALK**2])
        self.filter.restart(finding.joint, covariance=finding.covariance + floor)
        self.belief.close()
        self._poses.forget()

    def resume(self) -> None:
        """The alarm is closed: change detection starts from zero."""
        self._cusum.reset()
        self._since.clear()
        self._suspected = 0

    def limits(self, rows: list[StaticReading]) -> DetectionLimits:
        """Limits in work like these rows; over the whole range while they are few."""
        config, belief = self._config, self.belief
        wait = 0 if belief.level.is_known else max(0, config.window - self.rows)
        if len(rows) >= config.window:
            return limits(self.cause_test(rows), config, wait)
        position = belief.kernel.poses[:LONGEST_WINDOW]
        anywhere = StaticReadings.of(position, belief.torque(position), self.sigma)
        return limits(CauseTest(belief, anywhere), config, wait)

    def save(self) -> dict[str, Any]:
        saved = save_rows([row for row, _ in self._since])
        since = [[*row[:4], known, *row[4:]] for row, (_, known) in zip(saved, self._since, strict=True)]
        own: dict[str, Any] = {"sigma": self.sigma.tolist(), "rows": self.rows, "since": since}
        own["suspected_rows"] = self._suspected
        return own | self.belief.save() | self.filter.save() | self._cusum.save() | self._poses.save()

    def restore(self, values: dict[str, Any]) -> None:
        self.sigma, self.rows = as_array("sigma", values["sigma"], self.sigma.shape), int(values["rows"])
        saved, self._suspected = values.get("since", []), int(values.get("suspected_rows", 0))
        rows, known = (
            read_rows([[*row[:4], *row[5:]] for row in saved], len(self.sigma)),
            [bool(row[4]) for row in saved],
        )
        self._since = deque(zip(rows, known, strict=True), maxlen=self._since.maxlen)
        self.belief, self.filter = restored(self.belief, values), restored(self.filter, values)
        self._cusum, self._poses = restored(self._cusum, values), restored(self._poses, values)


def _arrays(rows: list[StaticReading]) -> tuple[Array, Array, Array, Array]:
    """Positions, torques, sides of approach and temperatures (K, n) of rows."""
    return stack(rows, "position"), stack(rows, "torque"), stack(rows, "direction"), stack(rows, "temperature")
