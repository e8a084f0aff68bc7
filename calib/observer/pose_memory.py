"""Places that the arm has been to: what a pose seen again can still teach."""

import numpy as np

from calib.records.records import Array


class Places:
    """Mean torque residual of every place, the latest `most` of them. Poses within `size` of one another are one place.

    At a place seen before, the model's own error is known, so that a change shows without it; and one more row there
    tells nothing new about the rest of the arm's range.
    """

    def __init__(self, n: int, size: float, most: int, rows: int) -> None:
        """n joints; size [rad] in the largest joint; after `rows` a place's mean stands, so as not to drift along."""
        self._size, self._most, self._rows = size, most, rows
        self.position: Array = np.empty((0, n))
        self.mean: Array = np.empty((0, n))
        self.count = np.empty(0, dtype=int)

    def seen(self, position: Array) -> int:
        """How many rows of this place are known, at most those that are kept."""
        at = self._find(position)
        return 0 if at is None else int(self.count[at])

    def expected(self, position: Array, variance: Array, noise: Array) -> tuple[Array, Array]:
        """Model error expected at a pose and its variance (n,), from rows seen there.

        `variance` (n,) is that of the model's error where the arm has not been, `noise` (n,) that of one row.
        """
        at = self._find(position)
        if at is None:
            return np.zeros_like(variance), variance
        share = variance / (variance + noise / self.count[at])
        return share * self.mean[at], (1 - share) * variance

    def add(self, position: Array, residual: Array) -> None:
        """Take a row without alarm."""
        at = self._find(position)
        if at is None:
            self.position = np.vstack([self.position, position])[-self._most :]
            self.mean = np.vstack([self.mean, residual])[-self._most :]
            self.count = np.append(self.count, 1)[-self._most :]
        elif self.count[at] < self._rows:
            self.count[at] += 1
            self.mean[at] += (residual - self.mean[at]) / self.count[at]

    def forget(self) -> None:
        """Start again: another calibration or model is in force."""
        self.position, self.mean, self.count = self.position[:0], self.mean[:0], self.count[:0]

    def _find(self, position: Array) -> int | None:
        if not len(self.position):
            return None
        away = np.abs(self.position - position).max(axis=1)
        nearest = int(away.argmin())
        return nearest if away[nearest] < self._size else None
