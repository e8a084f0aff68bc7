"""Memory of the poses that the arm has visited: a repeated pose adds no information, but shows change."""

from typing import Any

import numpy as np

from calib.observer.config import LONGEST_WINDOW
from gcomp.arrays import Array, as_array

PLACE_SIZE = 0.2
"""Poses within this distance in every joint count as one pose [rad]."""
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
        """Poses, mean residuals and counts as JSON values."""
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
