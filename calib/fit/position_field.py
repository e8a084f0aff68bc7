"""A Gaussian field over joint positions, as a few columns: what no named effect explains (docs/theory.md, 4.6)."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array

REST = 1e-2
"""Share of the field's variance that may be left out of its columns; it is added to the noise by the caller."""


@dataclass(frozen=True, eq=False)
class PositionField:
    """A field of unit level, expanded in landmark poses: φ(q) φ(q')ᵀ = its covariance, up to REST."""

    landmarks: Array
    """Poses (L, n) [rad]."""
    length: float
    """Distance over which the field is alike [rad]."""
    root: Array
    """Inverse of the Cholesky factor of the landmarks' covariance (L, L)."""

    @classmethod
    def over(cls, poses: Array, length: float) -> "PositionField":
        """The field for poses (K, n) [rad], by pivoted Cholesky decomposition."""
        chosen, left = list[int](), np.ones(len(poses))
        rows = np.zeros((0, len(poses)))
        while len(chosen) < len(poses) and left.max() > REST:
            pivot = int(np.argmax(left))
            row = kernel(poses[pivot : pivot + 1], poses, length)[0] - rows[:, pivot] @ rows
            row /= np.sqrt(left[pivot])
            rows = np.vstack([rows, row])
            left = left - row**2
            left[[*chosen, pivot]] = 0.0
            chosen.append(pivot)
        landmarks = poses[chosen]
        square = kernel(landmarks, landmarks, length) + 1e-9 * np.eye(len(chosen))
        return cls(landmarks, length, np.linalg.inv(np.linalg.cholesky(square)))

    def columns(self, poses: Array) -> Array:
        """φ at poses (K, n) → (K, L)."""
        columns: Array = kernel(poses, self.landmarks, self.length) @ self.root.T
        return columns


def kernel(one: Array, other: Array, length: float) -> Array:
    """Correlation (K, M) of a field of this length [rad] at poses (K, n) and (M, n) [rad]."""
    return np.asarray(np.exp(-squared_distance(one, other) / (2 * length**2)))


def squared_distance(one: Array, other: Array) -> Array:
    """Squared distance (K, M) of poses: Σ_l (2 sin(Δ_l/2))² = 2 Σ_l (1 − cos Δ_l), a turn of a joint being none."""
    cos, sin = np.cos(one) @ np.cos(other).T, np.sin(one) @ np.sin(other).T
    distance: Array = np.maximum(2 * (one.shape[1] - cos - sin), 0.0)
    return distance
