"""Level of the discrepancy: its standard deviation per joint, by restricted likelihood (docs/theory.md)."""

from dataclasses import dataclass, replace

import numpy as np

from calib.observer.discrepancy.kernel import PARTS
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array

SMALLEST = 0.05
"""Smallest level that is told from none, in standard deviations of one row."""
SHARES = np.array([0.4, 0.3, 0.2, 0.1])
"""Shares of the parts (`kernel.PARTS`, then the rough one) in the variance, before the first row."""
SPREAD_SHARES = 0.7
"""Standard deviation of the logarithm of a part, beside that of the whole."""
LEAST_SINGULAR_VALUE = 1e-6
"""Singular value of columns of unit length below which one of them depends on the others."""
STEPS, LONGEST = 6, 0.7
"""Steps of the search by Fisher scoring, and the longest one, in the logarithm of a standard deviation."""
SPREAD_UNKNOWN, SPREAD_KNOWN = 1.2, 0.4
"""Standard deviation of the level's logarithm before the first row: without a calibration's word on it, and at least
with one, since work is not done at the calibration's poses."""


@dataclass(frozen=True)
class DiscrepancyLevel:
    """Standard deviations of each joint's discrepancy [N·m]."""

    smooth: Array
    """Of the parts that are correlated over poses (`kernel.PARTS`, n)."""
    rough: Array
    """Of the part that is another one at each pose (n,)."""
    before: Array
    """Of all together, as expected before the first row (n,)."""
    spread: Array
    """Standard deviation of the logarithm of what was expected (n,)."""
    rows: int = 0
    """Rows that it was learned from."""

    @classmethod
    def none(cls, n: int) -> "DiscrepancyLevel":
        zero = np.zeros(n)
        return cls(np.zeros((len(PARTS), n)), zero, zero, zero + SPREAD_UNKNOWN)

    @classmethod
    def expected(cls, before: Array, spread: Array | None = None) -> "DiscrepancyLevel":
        """Before the first row; spread (n,) if a calibration has measured it."""
        parts = np.sqrt(SHARES)[:, None] * before
        return cls(parts[:-1], parts[-1], before, np.full_like(before, SPREAD_UNKNOWN) if spread is None else spread)

    @classmethod
    def of_record(cls, calibration: CalibrationRecord, otherwise: Array) -> "DiscrepancyLevel":
        """As the record has it, `otherwise` (n,) [N·m] for joints of which it says nothing."""
        level, std = calibration.discrepancy("level"), calibration.discrepancy("level_std")
        said = level > 0
        spread = np.clip(std / np.where(said, level, 1.0), SPREAD_KNOWN, SPREAD_UNKNOWN)
        return cls.expected(np.where(said, level, otherwise), np.where(said, spread, SPREAD_UNKNOWN))

    @property
    def total(self) -> Array:
        """Of all parts together (n,) [N·m]."""
        total: Array = np.sqrt((self.smooth**2).sum(axis=0) + self.rough**2)
        return total

    @property
    def is_known(self) -> bool:
        """Whether rows or a calibration have told it."""
        return self.rows > 0 or bool((self.spread < SPREAD_UNKNOWN).all())

    def fitted(self, unit: Array, residual: Array, noise: Array, known: Array, free: Array) -> "DiscrepancyLevel":
        """The level of greatest restricted likelihood, given what was expected; by Fisher scoring.

        unit (parts, n, N, N): covariance of the discrepancy's parts at level 1. residual (n, N) [N·m]: readings less
        model at N poses. noise (n,) [N·m]: of one row. known (n, N, P): columns of the model's stated uncertainty, with
        unit prior. free (n, N, p): columns of any size that the level must not take for discrepancy.
        """
        complement, told = _complement(free)
        across = complement.swapaxes(1, 2)
        left, columns = across @ residual[:, :, None], across @ known
        one = np.eye(told.shape[1])
        parts = np.concatenate([across @ unit @ complement, (told[:, :, None] * one)[None]])
        variance = np.where(told, noise[:, None] ** 2, 1.0)  # any where there is nothing
        fixed = columns @ columns.swapaxes(1, 2) + variance[:, :, None] * one
        least = SMALLEST * noise
        expected = np.log(np.maximum(np.sqrt(SHARES)[:, None] * self.before, least))
        weight = 1 / (self.spread**2 + SPREAD_SHARES**2)
        stds = np.maximum(np.vstack([self.smooth, self.rough]), least)
        for _ in range(STEPS):
            each = stds[:, :, None, None] ** 2 * parts
            inverse = np.linalg.inv(each.sum(axis=0) + fixed)
            explained, white = inverse @ each, inverse @ left
            gradient = np.einsum("mjaa->mj", explained) - np.einsum(
                "jao,mjab,jbo->mj", white, each, white, optimize=True
            )
            gradient += weight * (np.log(stds) - expected)
            flat = explained.swapaxes(0, 1).reshape(len(left), len(parts), -1)
            turned = explained.swapaxes(2, 3).swapaxes(0, 1).reshape(len(left), len(parts), -1)
            hessian = 2 * flat @ turned.swapaxes(1, 2) + weight[:, None, None] * np.eye(len(parts))
            step = np.linalg.solve(hessian, gradient.T[:, :, None])[:, :, 0].T
            stds = np.maximum(stds * np.exp(-np.clip(step, -LONGEST, LONGEST)), least)
        return replace(self, smooth=stds[:-1], rough=stds[-1], rows=residual.shape[1])


def _complement(columns: Array) -> tuple[Array, Array]:
    """Orthonormal basis (n, N, N) of what columns (n, N, p) do not span, and which of its vectors are any (n, N).

    The others are zero. Columns that depend on others, as a payload's do at the last joints, span nothing more.
    """
    size = np.linalg.norm(columns, axis=1, keepdims=True)
    vectors, lengths, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0))
    rank = (lengths > LEAST_SINGULAR_VALUE).sum(axis=1)
    told = np.arange(columns.shape[1]) >= rank[:, None]
    return vectors * told[:, None, :], told
