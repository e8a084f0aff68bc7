"""Rest detection: turns samples into rows, one averaged row per stop of the arm."""

from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
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

    def handle(self, t: float, position: Array, torque: Array) -> StaticReading | None:
        """Take one sample (SI, (n,) each, NaN if missing); returns the row of this rest once complete, else None."""
        config = self._config
        if np.isnan(position).any() or np.isnan(torque).any():
            return None
        moved = not np.abs(position - self._anchor).max() <= config.still_band
        if moved or t - self._last > LONGEST_GAP:
            self._restart(t, position, moved=moved)
        self._last = t
        if self._done or t - self._since < config.settle_time:
            return None
        self._samples.append((t, position.copy(), torque.copy()))
        if t - self._samples[0][0] < config.average_time:
            return None
        return self._complete()

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
