"""Rest detection: turns samples into rows, one averaged row per stop of the arm."""

from dataclasses import dataclass

import numpy as np

from calib.observer_config import ObserverConfig
from calib.records import Array


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


class RestDetector:
    """Averages position and torque over each rest. A rest is told by position alone where velocity is missing."""

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints."""
        self._config = config
        self._anchor = np.full(n, np.nan)
        self._since = self._last = -np.inf
        self._left = np.full(n, np.nan)
        self._direction = np.zeros(n)
        self._samples: list[tuple[float, Array, Array]] = []
        self._done = False

    def handle(self, t: float, position: Array, velocity: Array | None, torque: Array) -> Row | None:
        """Take one sample (SI, (n,) each, NaN where missing); the row of this rest once it is complete, else None."""
        config = self._config
        if np.isnan(position).any() or np.isnan(torque).any():
            return None
        moved = not np.abs(position - self._anchor).max() <= config.still_band
        fast = velocity is not None and bool((np.abs(velocity) > config.still_velocity).any())
        if moved or fast or t - self._last > config.gap_time:
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
            self._direction = np.where(np.abs(step) > self._config.still_band / 2, np.sign(step), self._direction)
        self._anchor, self._since = position.copy(), t
        self._samples.clear()
        away = np.abs(position - self._left).max()
        self._done = self._done and bool(away < self._config.new_pose)

    def _complete(self) -> Row | None:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        self._samples.clear()
        half = len(times) // 2
        first, second = torques[:half], torques[half:]
        scatter = np.sqrt((first.var(axis=0) + second.var(axis=0)) / max(half, 1))
        limit = self._config.steady_ratio * scatter + 1e-3 * np.abs(torques).mean(axis=0) + 1e-3
        if (np.abs(second.mean(axis=0) - first.mean(axis=0)) > limit).any():
            return None  # not steady yet: average anew
        here: Array = positions.mean(axis=0)
        self._left, self._done = here, True
        return Row(float(times.mean()), here, torques.mean(axis=0), self._direction)
