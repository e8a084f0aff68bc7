"""Tracking of every joint's sensor row by row: noise, filtered gain and offset, poses seen before, change detection.

The filter is a recursive estimate of gain and offset, relative to what is installed. A repeated pose adds no
information, but shows change. Change detection is a log-likelihood CUSUM on the residual against what is installed.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.fit.calibration import USUAL_ROWS
from calib.motion.static_reading import StaticReading, batch, stack
from calib.observer.cause_test import CauseTest, DetectionLimits, limits
from calib.observer.config import (
    AUDIT_ROWS,
    INITIAL_GAIN_STD,
    INITIAL_OFFSET_STD,
    LONGEST_WINDOW,
    PLACE_SIZE,
    ObserverConfig,
)
from calib.observer.decision import DriftFinding
from calib.observer.gravity_belief import GravityBelief
from calib.observer.saved_values import read_rows, restored, save_rows
from gcomp.arrays import Array, as_array
from gcomp.identify.readings import StaticReadings

GAIN_WALK = 1e-4
"""Random walk of the gain per accepted row (docs/theory.md, section 6): steady-state √(q σ/τ_rms) is 0.05 % for a joint
loaded with 10 N·m."""
OFFSET_WALK = 2e-3
"""Random walk of the offset per accepted row [N·m] (likewise): steady-state √(q σ) is 0.01 N·m at σ = 0.05 N·m."""
OUTLIER = 10.8
"""A row is rejected if its squared innovation over the variance is larger: noise exceeds this χ², with 1 degree of
freedom, once in 1000."""


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


class SensorFilter:
    """One Kalman filter per joint; its state (gain, offset) is a random walk: reading = gain·τ + offset.

    Relative to the installed calibration: (1, 0) while that is right. Equations: docs/theory.md, section 6.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints, each assumed to be as installed."""
        self._config = config
        self.state: Array = np.tile([1.0, 0.0], (n, 1))
        """Gain and offset [N·m] (n, 2)."""
        self._initial = np.diag([INITIAL_GAIN_STD**2, INITIAL_OFFSET_STD**2])
        self.covariance: Array = np.tile(self._initial, (n, 1, 1))
        """Of gain and offset (n, 2, 2)."""
        self.accepted = np.zeros(n, dtype=int)
        """Rows that went into each joint's estimate (n,)."""
        self.rejected = np.zeros(n, dtype=int)
        """Consecutive rows rejected as outliers (n,)."""
        self._recent: deque[Array] = deque(maxlen=LONGEST_WINDOW)

    def handle(self, reading: Array, torque: Array, variance: Array) -> None:
        """Update with one row: reading and model torque (n,) [N·m], variance of their difference (n,) [N²·m²]."""
        self._recent.append(torque)
        spread = len(self._recent) * np.var(np.array(self._recent), axis=0)
        excited = spread * self._config.gain_std**2 >= variance
        for j in range(len(self.state)):
            self._update(j, reading[j], np.array([torque[j], 1.0]), variance[j], bool(excited[j]))

    def _update(self, j: int, reading: float, h: Array, variance: float, excited: bool) -> None:
        walk = np.diag([GAIN_WALK**2 if excited else 0.0, OFFSET_WALK**2])
        predicted = self.covariance[j] + walk
        of_innovation = h @ predicted @ h + variance
        innovation = reading - h @ self.state[j]
        if innovation**2 > OUTLIER * of_innovation:
            self.rejected[j] += 1
            return
        weight = predicted @ h / of_innovation
        if not excited:
            weight[0] = 0.0  # the gain keeps its value and uncertainty
        keep = np.eye(2) - np.outer(weight, h)
        self.state[j] += weight * innovation
        self.covariance[j] = keep @ predicted @ keep.T + np.outer(weight, weight) * variance
        self.accepted[j] += 1
        self.rejected[j] = 0

    def restart(self, j: int, gain: float = 1.0, offset: float = 0.0, covariance: Array | None = None) -> None:
        """Reset joint j to these values and covariance (2, 2); by default to "as installed"."""
        self.state[j] = (gain, offset)
        self.covariance[j] = self._initial if covariance is None else covariance
        self.rejected[j] = 0

    def estimate(self) -> Estimate:
        gain_std, offset_std = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)).T
        gain, offset = self.state.T.copy()
        return Estimate(gain, gain_std, offset, offset_std, self.accepted.copy())

    def save(self) -> dict[str, Any]:
        """State, covariance, counters and the recent model torques, as JSON values."""
        arrays = {name: getattr(self, name).tolist() for name in ("state", "covariance", "accepted", "rejected")}
        return {**arrays, "recent": [torque.tolist() for torque in self._recent]}

    def restore(self, values: dict[str, Any]) -> None:
        n = len(self.state)
        self.state = as_array("state", values["state"], (n, 2))
        self.covariance = as_array("covariance", values["covariance"], (n, 2, 2))
        self.accepted, self.rejected = (
            as_array(key, values[key], (n,)).astype(int) for key in ("accepted", "rejected")
        )
        recent = [as_array("recent", torque, (n,)) for torque in values["recent"]]
        self._recent = deque(recent, maxlen=self._recent.maxlen)


CHANNELS = ("gain up", "gain down", "offset up", "offset down")
ALARM_THRESHOLD = 10.0
"""Log-likelihood ratio of an alarm (docs/theory.md, section 6): one false alarm in 1.1e4 rows of a seven-joint arm,
which only starts a test."""


class Cusum:
    """Four channels per joint, h ∈ {±δ_k τ, ±δ_o}: S ← max(0, S + (h e − h²/2)/R), alarm above the threshold.

    The residual e is taken against the installed calibration, because the innovations of a tracking filter would hide
    slow drift (docs/theory.md, section 6).
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._config = config
        self._sums: Array = np.zeros((n, len(CHANNELS)))
        self._rising = np.zeros((n, len(CHANNELS)), dtype=int)

    def handle(self, residual: Array, torque: Array, variance: Array) -> list[tuple[int, str]]:
        """Update with one row; returns joints and channels in alarm.

        residual and model torque (n,) [N·m], variance of the residual (n,) [N²·m²].
        """
        gain = self._config.alarm_gain * torque
        offset = np.full_like(torque, self._config.alarm_offset)
        change = np.stack([gain, -gain, offset, -offset], axis=1)
        ratio = (change * residual[:, None] - change**2 / 2) / variance[:, None]
        self._sums = np.maximum(0.0, self._sums + ratio)
        self._rising = np.where(self._sums > 0.0, self._rising + 1, 0)
        return [(int(j), CHANNELS[c]) for j, c in np.argwhere(self._sums > ALARM_THRESHOLD)]

    def reset(self) -> None:
        self._sums, self._rising = np.zeros_like(self._sums), np.zeros_like(self._rising)

    def rising(self, joint: int, channel: str) -> int:
        """Rows since a channel's sum was last 0, at least 1."""
        return max(1, int(self._rising[joint, CHANNELS.index(channel)]))

    def drop(self, joint: int, channel: str) -> None:
        """Set one channel's sum to zero: the model's own error has raised it."""
        at = joint, CHANNELS.index(channel)
        self._sums[at], self._rising[at] = 0.0, 0

    def save(self) -> dict[str, Any]:
        return {"sums": self._sums.tolist(), "rising": self._rising.tolist()}

    def restore(self, values: dict[str, Any]) -> None:
        shape, unknown = self._sums.shape, np.zeros_like(self._sums)
        self._sums = as_array("sums", values["sums"], shape)
        self._rising = as_array("rising", values.get("rising", unknown), shape).astype(int)


PLACE_ROWS = 3
"""Rows of one pose that the filter and a window take: a repeated pose adds no information."""
PLACE_MEMORY = 20
"""Rows that the mean residual of a pose is made of; the mean's error, σ/√20, is small against an alarm."""


class PoseMemory:
    """Mean torque residual at each of the latest poses. Poses closer than `PLACE_SIZE` in every joint count as one.

    At a pose visited before, the error of the gravity model is known, so that a change stands out from it; another row
    there adds no information about the rest of the joint range.
    """

    def __init__(self, n: int) -> None:
        self._position: Array = np.empty((0, n))
        self._mean: Array = np.empty((0, n))
        self._count = np.empty(0, dtype=int)

    def seen(self, position: Array) -> int:
        """Number of rows known at this pose (n,), at most `PLACE_MEMORY`."""
        at = self._find(position)
        return 0 if at is None else int(self._count[at])

    def expected(self, position: Array, variance: Array, noise: Array) -> tuple[Array, Array]:
        """Model error (n,) [N·m] expected at a pose, from the rows seen there, and its variance (n,) [N²·m²].

        `variance` (n,) is that of the model error at an unvisited pose, `noise` (n,) that of one row.
        """
        at = self._find(position)
        if at is None:
            return np.zeros_like(variance), variance
        share = variance / (variance + noise / self._count[at])
        return share * self._mean[at], (1 - share) * variance

    def add(self, position: Array, residual: Array) -> None:
        """Take a row without alarm: pose (n,) [rad], reading less model (n,) [N·m]."""
        at, most = self._find(position), LONGEST_WINDOW
        if at is None:
            self._position = np.vstack([self._position, position])[-most:]
            self._mean = np.vstack([self._mean, residual])[-most:]
            self._count = np.append(self._count, 1)[-most:]
        elif self._count[at] < PLACE_MEMORY:  # then frozen, so as not to follow a drift
            self._count[at] += 1
            self._mean[at] += (residual - self._mean[at]) / self._count[at]

    def forget(self) -> None:
        """Drop every pose: another calibration or gravity model is in use."""
        self._position, self._mean, self._count = self._position[:0], self._mean[:0], self._count[:0]

    def save(self) -> dict[str, Any]:
        return {"places": [self._position.tolist(), self._mean.tolist(), self._count.tolist()]}

    def restore(self, values: dict[str, Any]) -> None:
        position, mean, count = values["places"]
        poses, n = len(position), self._position.shape[1]
        self._position = as_array("position", np.reshape(position, (-1, n)), (poses, n))
        self._mean = as_array("mean", np.reshape(mean, (-1, n)), (poses, n))
        self._count = as_array("count", count, (poses,)).astype(int)

    def _find(self, position: Array) -> int | None:
        if not len(self._position):
            return None
        away = np.abs(self._position - position).max(axis=1)
        nearest = int(away.argmin())
        return nearest if away[nearest] < PLACE_SIZE else None


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
        weight = 1 / min(self.rows + USUAL_ROWS, NOISE_MEMORY)
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
