"""Rows of an arm's work, made of its samples: one of each rest, or one of each joint that moves steadily.

Rests tell gravity where the torque has a sensor. Where torque is a motor current, friction hides gravity at rest; while
a joint moves, friction has a known sign.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from calib.motion.static_reading import LEAST_SAMPLES, StaticReading, slope
from calib.observer.config import LONGEST_GAP, ObserverConfig
from calib.observer.saved_values import known
from gcomp.arrays import Array, as_array

NEW_POSE = 0.05
"""A stop counts as another one once some joint has moved this far [rad]: a long rest is one row."""


class RestDetector:
    """Averages position and torque over each rest.

    Rest is detected from position alone, because velocity derived from an encoder is coarse.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._config = config
        self._anchor = np.full(n, np.nan)
        self._since, self._last = -np.inf, -np.inf
        self._last_stop = np.full(n, np.nan)
        self._direction = np.zeros(n)
        self._samples: list[tuple[float, Array, Array]] = []
        self._done = False

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[StaticReading]:
        """Take one sample ((n,) each, SI, temperatures in °C, NaN if missing); the row of this rest once complete."""
        config = self._config
        if np.isnan(position).any() or np.isnan(torque).any():
            return []
        moved = not np.abs(position - self._anchor).max() <= config.still_band
        if moved or t - self._last > LONGEST_GAP:
            self._restart(t, position, moved=moved)
        self._last = t
        if self._done or t - self._since < config.settle_time:
            return []
        self._samples.append((t, position.copy(), torque.copy()))
        if t - self._samples[0][0] < config.average_time:
            return []
        row = self._complete()
        return [row if temperature is None else replace(row, temperature=temperature)]

    def save(self) -> dict[str, Any]:
        """Directions of the last motion and the last stop, as JSON values."""
        return {"direction": self._direction.tolist(), "left": known(self._last_stop)}

    def restore(self, values: dict[str, Any]) -> None:
        shape, stop = self._direction.shape, [np.nan if q is None else q for q in values["left"]]
        self._direction = as_array("direction", values["direction"], shape)
        self._last_stop = as_array("left", stop, shape, finite=False)

    def _restart(self, t: float, position: Array, moved: bool) -> None:
        if moved:
            step = position - self._anchor
            self._direction = np.where(np.abs(step) > self._config.still_band / 2, np.sign(step), self._direction)
        self._anchor, self._since = position.copy(), t
        self._samples.clear()
        away = np.abs(position - self._last_stop).max()
        self._done = self._done and bool(away < NEW_POSE)

    def _complete(self) -> StaticReading:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        self._samples.clear()
        half = len(times) // 2
        error = np.abs(torques[:half].mean(axis=0) - torques[half:].mean(axis=0)) / 2
        here: Array = positions.mean(axis=0)
        self._last_stop, self._done = here, True
        return StaticReading.of(
            float(times.mean()), here, torques.mean(axis=0), self._direction, count=len(times), torque_error=error
        )


WIDTH = 0.1
"""A stretch is complete when some joint has moved this far [rad]: two or three periods of a motor's cogging."""
LEAST_SECONDS, MOST_SECONDS = 0.2, 3.0
"""Shortest and longest stretch [s]: a slower joint creeps below the speeds at which its friction is known."""
SLOWEST = 0.03
"""Below this speed friction depends on the time at rest [rad/s]: such a joint gives no row."""
STEADY = 0.15
"""Largest acceleration in a stretch [rad/s²]: 1 kg·m² then takes 0.15 N·m."""
TURNED = 0.03
"""After a reversal friction has turned round once the joint has moved so far [rad]."""


class MotionDetector:
    """Cuts the samples of an arm of n joints into stretches of motion, and averages the steady ones.

    A stretch counts only if no joint of the arm speeds up or slows down in it, so that inertia takes no torque.
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self._samples: list[tuple[float, Array, Array]] = []
        self._side = np.zeros(n)
        self._turned_at = np.full(n, np.nan)

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[StaticReading]:
        """Take one sample likewise; the rows of the stretch that it completes."""
        if not (np.isfinite(position).all() and np.isfinite(torque).all()):
            self._samples.clear()
            return []
        if self._samples and not 0 < t - self._samples[-1][0] <= LONGEST_GAP:
            self._samples.clear()
        self._samples.append((t, position.copy(), torque.copy()))
        first = self._samples[0]
        if np.abs(position - first[1]).max() < WIDTH or t - first[0] < LEAST_SECONDS:
            if t - first[0] > MOST_SECONDS:
                self._samples = [self._samples[-1]]
            return []
        rows = self._rows(np.full(self.n, np.nan) if temperature is None else temperature)
        self._samples = [self._samples[-1]]
        return rows

    def save(self) -> dict[str, Any]:
        """Nothing: a stretch that a restart cuts off is lost."""
        return {}

    def restore(self, values: dict[str, Any]) -> None: ...

    def _rows(self, temperature: Array) -> list[StaticReading]:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        if len(times) < LEAST_SAMPLES:
            return []
        half = len(times) // 2
        early, late = slope(times[: half + 1], positions[: half + 1]), slope(times[half:], positions[half:])
        velocity = (positions[-1] - positions[0]) / (times[-1] - times[0])
        side = np.where(np.abs(velocity) >= SLOWEST, np.sign(velocity), 0.0)
        turned = (side != 0) & (side != self._side)
        self._turned_at = np.where(turned, positions[0], self._turned_at)
        self._side = np.where(side != 0, side, self._side)
        if (np.abs(late - early) > STEADY * (times[-1] - times[0]) / 2).any():
            return []
        onward = (np.sign(early) == side) & (np.sign(late) == side)
        settled = np.abs(positions[0] - self._turned_at) >= TURNED
        weight = np.hanning(len(times) + 2)[1:-1]  # suppresses ripple with the position
        weight /= weight.sum()
        here, pull, when = weight @ positions, weight @ torques, float(weight @ times)
        return [
            StaticReading.of_motion(when, j, here, float(pull[j]), float(velocity[j]), float(temperature[j]))
            for j in np.flatnonzero((side != 0) & onward & settled).tolist()
        ]
