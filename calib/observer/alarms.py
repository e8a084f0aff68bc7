"""Alarms: single rows that show a change of a sensor beyond the model's own error, before any test of its cause.

Change detection is a log-likelihood CUSUM on the residual against what is installed. A repeated pose adds no
information, but shows change.
"""

from collections import deque
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading, stack
from calib.observer.config import AUDIT_ROWS, LONGEST_WINDOW, PLACE_SIZE, ObserverConfig
from calib.observer.gravity_belief import GravityBelief
from calib.observer.saved_values import read_rows, restored, save_rows
from gcomp.arrays import Array, as_array

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
        self.sums: Array = np.zeros((n, len(CHANNELS)))
        self._rising = np.zeros((n, len(CHANNELS)), dtype=int)

    def handle(self, residual: Array, torque: Array, variance: Array) -> list[tuple[int, str]]:
        """Update with one row; returns joints and channels in alarm.

        residual and model torque (n,) [N·m], variance of the residual (n,) [N²·m²].
        """
        gain = self._config.alarm_gain * torque
        offset = np.full_like(torque, self._config.alarm_offset)
        change = np.stack([gain, -gain, offset, -offset], axis=1)
        ratio = (change * residual[:, None] - change**2 / 2) / variance[:, None]
        self.sums = np.maximum(0.0, self.sums + ratio)
        self._rising = np.where(self.sums > 0.0, self._rising + 1, 0)
        return [(int(j), CHANNELS[c]) for j, c in np.argwhere(self.sums > ALARM_THRESHOLD)]

    def reset(self) -> None:
        self.sums, self._rising = np.zeros_like(self.sums), np.zeros_like(self._rising)

    def rising(self, joint: int, channel: str) -> int:
        """Rows since a channel's sum was last 0, at least 1."""
        return max(1, int(self._rising[joint, CHANNELS.index(channel)]))

    def drop(self, joint: int, channel: str) -> None:
        """Set one channel's sum to zero: the model's own error has raised it."""
        at = joint, CHANNELS.index(channel)
        self.sums[at], self._rising[at] = 0.0, 0

    def save(self) -> dict[str, Any]:
        return {"sums": self.sums.tolist(), "rising": self._rising.tolist()}

    def restore(self, values: dict[str, Any]) -> None:
        shape, unknown = self.sums.shape, np.zeros_like(self.sums)
        self.sums = as_array("sums", values["sums"], shape)
        self._rising = as_array("rising", values.get("rising", unknown), shape).astype(int)


PLACE_ROWS = 3
"""Rows of one pose that a window takes: a repeated pose adds no information."""
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


DOUBT = 4.0
"""An alarm is one at once if its log-likelihood ratio is this many times larger than needed, where the model's error is
all there is beside it; else it is first confirmed."""

Alarm = tuple[str, int, str]
"""Kind (alarm or suspicion), joint, channel."""


class AlarmWatch:
    """Every joint's sensor against the gravity model as it is believed. Rows have true-angle positions."""

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._cusum = Cusum(n, config)
        self._poses = PoseMemory(n)
        self._suspected = 0
        """Rows for which there has been a suspicion: it may yet become an alarm."""
        self._since: deque[tuple[StaticReading, bool]] = deque(maxlen=config.window)

    def watch(self, row: StaticReading, belief: GravityBelief) -> list[Alarm]:
        """Take a row while no alarm is open."""
        q, noise = row.position, belief.sigma**2
        expected = belief.expected(q[None], row.direction[None], row.temperature[None])
        torque = expected.torque[0]
        residual = row.torque - torque - expected.mean[0]
        here, left = self._poses.expected(q, expected.variance[0], noise)
        self._since.append((row, self._poses.seen(q) >= PLACE_ROWS))
        if not belief.level.is_known:
            return []
        alarms = self._cusum.handle(residual - here, torque, noise + left)
        if alarms and (told := self._judged(alarms, belief)) is not None:
            return told
        self._poses.add(q, residual)
        return []

    def forget_poses(self) -> None:
        """Another calibration, or another model, is in use."""
        self._poses.forget()

    def resume(self) -> None:
        """The alarm is closed: change detection starts from zero."""
        self._cusum.reset()
        self._since.clear()
        self._suspected = 0

    def _judged(self, alarms: list[tuple[int, str]], belief: GravityBelief) -> list[Alarm] | None:
        """Alarms of the CUSUM to tell now, none while they are open; None if all were the model's error."""
        found = [(self._seen_as(*alarm, belief), *alarm) for alarm in alarms]
        for kind, joint, channel in found:
            if not kind:
                self._cusum.drop(joint, channel)
        seen = [alarm for alarm in found if alarm[0]]
        self._suspected = self._suspected + 1 if seen else 0
        certain = [alarm for alarm in seen if alarm[0] == "alarm"]
        if certain or self._suspected >= AUDIT_ROWS:
            return certain or seen
        return [] if seen else None

    def _seen_as(self, joint: int, channel: str, belief: GravityBelief) -> str:
        """Whether the rows since a channel began to rise show its change beyond the model's own, correlated error.

        "alarm" if they do without doubt, "suspicion" if other rows must confirm it, "" if they do not.
        """
        latest = list(self._since)[-self._cusum.rising(joint, channel) :]
        if 2 * sum(known for _, known in latest) > len(latest):
            return "alarm"  # at places whose error is known
        rows, noise = [row for row, _ in latest], belief.sigma[joint] ** 2
        expected = belief.expected(*(stack(rows, name) for name in ("position", "direction", "temperature")))
        torque = expected.torque[:, joint]
        residual = stack(rows, "torque")[:, joint] - torque - expected.mean[:, joint]
        covariance = expected.of_joint(joint) + noise * np.eye(len(rows))
        change = torque if channel.startswith("gain") else np.ones_like(torque)
        weight = np.linalg.solve(covariance, change)
        of_model = 1 - noise * len(rows) / float(np.trace(covariance))
        shown = float((weight @ residual) ** 2 / (weight @ change)) / (2 * ALARM_THRESHOLD)
        if shown <= 1:
            return ""
        return "alarm" if shown > 1 + DOUBT * of_model else "suspicion"

    def save(self) -> dict[str, Any]:
        saved = save_rows([row for row, _ in self._since])
        since = [[*row[:4], known, *row[4:]] for row, (_, known) in zip(saved, self._since, strict=True)]
        return {"since": since, "suspected_rows": self._suspected} | self._cusum.save() | self._poses.save()

    def restore(self, values: dict[str, Any]) -> None:
        saved, self._suspected = values.get("since", []), int(values.get("suspected_rows", 0))
        rows = read_rows([[*row[:4], *row[5:]] for row in saved], len(self._cusum.sums))
        self._since = deque(zip(rows, (bool(row[4]) for row in saved), strict=True), maxlen=self._since.maxlen)
        self._cusum, self._poses = restored(self._cusum, values), restored(self._poses, values)
