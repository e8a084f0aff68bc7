"""Rest detection: turns samples into rows, one averaged row per stop of the arm."""

from dataclasses import dataclass

import numpy as np

from calib.observer.config import ObserverConfig
from calib.records.records import Array


@dataclass(frozen=True)
class Row:
    """One stop of the arm."""

    t: float
    """Middle of the average [s]."""
    position: Array
    """Mean position reading (n,) [rad]."""
    torque: Array
    """Mean torque reading (n,) [N·m]."""
    direction: Array
    """Sign of each joint's last motion (n,): +1, -1, or 0 where it has not moved yet."""
    noise: Array | None = None
    """Half the difference of the average's two halves (n,) [N·m]: as large as the average's own error."""


class RestDetector:
    """Averages position and torque over each rest, which position alone tells: velocity from an encoder is coarse."""

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints."""
        self._config = config
        self._anchor = np.full(n, np.nan)
        self._since, self._last = -np.inf, -np.inf
        self.left = np.full(n, np.nan)
        self.direction = np.zeros(n)
        self._samples: list[tuple[float, Array, Array]] = []
        self._done = False

    def handle(self, t: float, position: Array, torque: Array) -> Row | None:
        """Take one sample (SI, (n,) each, NaN where missing); the row of this rest once it is complete, else None."""
        config = self._config
        if np.isnan(position).any() or np.isnan(torque).any():
            return None
        moved = not np.abs(position - self._anchor).max() <= config.still_band
        if moved or t - self._last > config.gap_time:
            self._restart(t, position, moved=moved)
        self._last = t
        if self._done or t - self._since < config.settle_time:
            return None
        self._samples.append((t, position.copy(), torque.copy()))
        if t - self._samples[0][0] < config.average_time:
            return None
        return self._complete()

    def _restart(self, t: float, position: Array, moved: bool) -> None:
        if moved:
            step = position - self._anchor
            self.direction = np.where(np.abs(step) > self._config.still_band / 2, np.sign(step), self.direction)
        self._anchor, self._since = position.copy(), t
        self._samples.clear()
        away = np.abs(position - self.left).max()
        self._done = self._done and bool(away < self._config.new_pose)

    def _complete(self) -> Row:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        self._samples.clear()
        half = len(times) // 2
        noise = (torques[:half].mean(axis=0) - torques[half:].mean(axis=0)) / 2
        here: Array = positions.mean(axis=0)
        self.left, self._done = here, True
        return Row(float(times.mean()), here, torques.mean(axis=0), self.direction, noise)
