"""Every joint's sensor against the gravity model, row by row: noise, gain and offset, and whether they have changed.

Gain and offset are relative to what is installed, and so are the residuals that a change is looked for in: against an
estimate that follows the sensor a slow drift would hide.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.fit.calibration import USUAL_ROWS
from calib.motion.static_reading import StaticReading, batch, stack
from calib.observer.cause_test import CauseTest
from calib.observer.config import AUDIT_ROWS, INITIAL_GAIN_STD, INITIAL_OFFSET_STD, LONGEST_WINDOW
from calib.observer.decision import DriftFinding
from calib.observer.discrepancy import PLACE_SIZE
from calib.observer.evidence import DetectionLimits
from calib.observer.gravity_belief import GravityBelief
from calib.observer.saved_values import read_rows, restored, save_rows
from gcomp.arrays import Array, as_array
from gcomp.identify.readings import StaticReadings


@dataclass(frozen=True)
class Estimate:
    """Gain and offset of every joint against the installed calibration, with standard deviations; (n,) each."""

    gain: Array
    gain_std: Array
    offset: Array
    """[N·m]"""
    offset_std: Array
    accepted: Array
    """Rows that went into each."""

    @classmethod
    def of(cls, change: Array, covariance: Array, accepted: Array) -> "Estimate":
        """Of changes of gain and offset (n, 2), their covariances (n, 2, 2), and rows (n,)."""
        gain, offset = change.T
        gain_std, offset_std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
        return cls(1 + gain, gain_std, offset.copy(), offset_std, accepted.copy())


UNCHANGED = np.array([1.0, 0.0])
"""Gain and offset [N·m] of a joint that is as installed."""
CHANNELS = ("gain", "offset")
ALARM_THRESHOLD = 12.0
"""Log-likelihood ratio of an alarm (docs/theory.md, section 6): false in one of 1e4 rows of a seven-joint arm, which
only starts a test."""
DOUBT = 4.0
"""An alarm is one at once if its log-likelihood ratio is this many times larger than needed, where the model's error is
all there is beside it; what is smaller is left to the audits."""
NOISE_MEMORY = 200
"""Rows that the measured standard deviation is averaged over: known within 5 % by then."""
STEADY, CHANCE = 8.0, 3.0
"""The two halves of a rest's average may differ by this many standard deviations of it, and do by chance at most."""


def change_ratios(residual: Array, torque: Array, covariance: Array) -> tuple[Array, Array]:
    """Log-likelihood ratio of a change of gain and of offset from each of K rows on, and its size, (n, 2, K) each.

    residual and model torque (K, n) [N·m], covariance of each joint's residuals (n, K, K).
    """
    count, n = residual.shape
    since = np.broadcast_to(np.tri(count), (n, count, count))
    columns = np.concatenate([torque.T[:, :, None] * since, since], axis=2)
    white = np.linalg.solve(np.linalg.cholesky(covariance), np.dstack([residual.T, columns]))
    shown = np.einsum("jk,jkc->jc", white[:, :, 0], white[:, :, 1:])
    square = np.maximum((white[:, :, 1:] ** 2).sum(axis=1), 1e-300)
    shape = n, len(CHANNELS), count
    return (shown**2 / square / 2).reshape(shape), (shown / square).reshape(shape)


class Tracking:
    """The gravity model as it is believed, and every joint's sensor against it. Rows have true-angle positions."""

    def __init__(self, belief: GravityBelief, sigma: Array, window: int) -> None:
        """sigma (n,) [N·m]: standard deviation of one row's torque to begin with, replaced by the measured one; window:
        rows in which a change is looked for."""
        n = belief.arm.n
        self.belief, self.sigma = belief, np.asarray(sigma, dtype=float)
        self.rows = 0
        """Rows taken."""
        self.state: Array = np.tile(UNCHANGED, (n, 1))
        """Gain and offset [N·m] (n, 2)."""
        self.covariance: Array = np.tile(np.diag([INITIAL_GAIN_STD**2, INITIAL_OFFSET_STD**2]), (n, 1, 1))
        """Of gain and offset (n, 2, 2)."""
        self.accepted = np.zeros(n, dtype=int)
        """Rows that went into each joint's estimate (n,)."""
        self._latest: deque[StaticReading] = deque(maxlen=window)

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
        weight = 1 / min(self.rows + USUAL_ROWS, NOISE_MEMORY)
        self.sigma = np.sqrt((1 - weight) * self.sigma**2 + weight * error**2)
        return steady

    def watch(self, row: StaticReading, known: list[StaticReading]) -> list[tuple[int, str]]:
        """Take a row while no alarm is open; the joints that have certainly changed with it, and how.

        `known` rows of before tell the model's error where the arm has returned to them.
        """
        self._latest.append(row)
        if not self.belief.level.is_known:
            return []
        latest = stack(self._latest, "position")
        before = [each for each in known if (np.abs(latest - each.position).max(axis=1) < PLACE_SIZE).any()]
        rows = [each for each in before if each.t < self._latest[0].t] + list(self._latest)
        expected = self.belief.expected(*(stack(rows, name) for name in ("position", "direction", "temperature")))
        residual = stack(rows, "torque") - expected.torque - expected.mean
        covariance = expected.of_joints + self.sigma[:, None, None] ** 2 * np.eye(len(rows))
        ratio, size = change_ratios(residual, expected.torque, covariance)
        variance = np.diagonal(covariance, axis1=1, axis2=2)[:, ::-1].cumsum(axis=1)[:, ::-1]
        of_model = 1 - self.sigma[:, None] ** 2 * np.arange(len(rows), 0, -1) / variance
        beyond = ratio / (1 + DOUBT * of_model)[:, None]
        change = np.take_along_axis(size, beyond.argmax(axis=2)[:, :, None], axis=2)[:, :, 0]
        return [
            (joint, f"{CHANNELS[channel]} {'up' if change[joint, channel] > 0 else 'down'}")
            for joint, channel in np.argwhere(beyond.max(axis=2) > ALARM_THRESHOLD).tolist()
        ]

    def follow(self, test: CauseTest) -> None:
        """Estimate gains and offsets by rows in which nothing has changed so far that would be told."""
        for joint in range(len(self.state)):
            change, self.covariance[joint] = test.sensor(joint)
            self.state[joint] = UNCHANGED + change
        self.accepted += AUDIT_ROWS

    def cause_test(self, rows: list[StaticReading]) -> CauseTest:
        """The cause test of these rows, by the belief from rows before them."""
        belief = self.belief.before(rows[0].position)
        return CauseTest(belief, batch(rows, self.sigma), stack(rows, "temperature"))

    def restart(self, joint: int, change: Array, covariance: Array) -> None:
        """Set a joint's change of gain and offset (2,), as rows of an alarm show it."""
        self.state[joint], self.covariance[joint] = UNCHANGED + change, covariance

    def install(self, finding: DriftFinding) -> None:
        """The finding was written: its joint is as installed, within the finding's uncertainty."""
        self.restart(finding.joint, np.zeros(2), finding.covariance)
        self.belief.close()

    def resume(self) -> None:
        """The alarm is closed: change detection starts from zero."""
        self._latest.clear()

    def estimate(self) -> Estimate:
        return Estimate.of(self.state - UNCHANGED, self.covariance, self.accepted)

    def limits(self, rows: list[StaticReading]) -> DetectionLimits:
        """Limits in work like these rows; over the whole range while they are few.

        A change is noticed if it stands out of a window of the longest kind, and rows after it confirm it.
        """
        belief, window = self.belief, self._latest.maxlen or 0
        wait = 0 if belief.level.is_known else max(0, window - self.rows)
        if len(rows) >= window:
            test = self.cause_test(rows)
        else:
            position = belief.kernel.poses[:LONGEST_WINDOW]
            test = CauseTest(belief, StaticReadings.of(position, belief.torque(position), self.sigma))
        longer = LONGEST_WINDOW / len(test.window.position)
        return test.limits(belief.arm.n, wait + LONGEST_WINDOW + 2 * window, longer)

    def save(self) -> dict[str, Any]:
        arrays = {name: getattr(self, name).tolist() for name in ("sigma", "state", "covariance", "accepted")}
        return {**arrays, "rows": self.rows, "latest": save_rows(list(self._latest))} | self.belief.save()

    def restore(self, values: dict[str, Any]) -> None:
        n = len(self.sigma)
        self.sigma, self.rows = as_array("sigma", values["sigma"], (n,)), int(values["rows"])
        self.state = as_array("state", values["state"], (n, 2))
        self.covariance = as_array("covariance", values["covariance"], (n, 2, 2))
        self.accepted = as_array("accepted", values["accepted"], (n,)).astype(int)
        self._latest = deque(read_rows(values.get("latest", []), n), maxlen=self._latest.maxlen)
        self.belief = restored(self.belief, values)
