"""Places that the arm has been to: what a pose seen again can still teach."""

import numpy as np

from calib.records import Array


class Places:
    """Mean torque residual of every place, the latest `most` of them. Poses within `size` of one another are one place.

    At a place seen before, the model's own error is known, so that a change shows without it; and one more row there
    tells nothing new about the rest of the arm's range.
    """

    def __init__(self, n: int, size: float, most: int, rows: int) -> None:
        """n joints; size [rad] in the largest joint; after `rows` a place's mean stands, so as not to drift along."""
        self._size, self._most, self._rows = size, most, rows
        self._position: Array = np.empty((0, n))
        self._mean: Array = np.empty((0, n))
        self._count = np.empty(0, dtype=int)

    def seen(self, position: Array) -> int:
        """How many rows of this place are known, at most those that are kept."""
        at = self._find(position)
        return 0 if at is None else int(self._count[at])

    def expected(self, position: Array, variance: Array, noise: Array) -> tuple[Array, Array]:
        """Model error expected at a pose and its variance (n,), from rows seen there.

        `variance` (n,) is that of the model's error where the arm has not been, `noise` (n,) that of one row.
        """
        at = self._find(position)
        if at is None:
            return np.zeros_like(variance), variance
        share = variance / (variance + noise / self._count[at])
        return share * self._mean[at], (1 - share) * variance

    def add(self, position: Array, residual: Array) -> None:
        """Take a row without alarm."""
        at = self._find(position)
        if at is None:
            self._position = np.vstack([self._position, position])[-self._most :]
            self._mean = np.vstack([self._mean, residual])[-self._most :]
            self._count = np.append(self._count, 1)[-self._most :]
        elif self._count[at] < self._rows:
            self._count[at] += 1
            self._mean[at] += (residual - self._mean[at]) / self._count[at]

    def forget(self) -> None:
        """Start again: another calibration or model is in force."""
        self._position, self._mean, self._count = self._position[:0], self._mean[:0], self._count[:0]

    def _find(self, position: Array) -> int | None:
        if not len(self._position):
            return None
        away = np.abs(self._position - position).max(axis=1)
        nearest = int(away.argmin())
        return nearest if away[nearest] < self._size else None
