"""Least squares on many rows in little memory: a triangular factor that is updated block by block."""

from collections.abc import Iterable

import numpy as np

from gcomp.arrays import Array

ROWS = 192
"""Rows per update. A factorisation this small stays in the cache and on one thread; from 384 rows LAPACK uses threads,
which on a busy machine is ten to a hundred times slower."""


def fold(triangle: Array, rows: Array) -> Array:
    """Triangular factor (p, p) of all rows folded in before and of the rows (K, p)."""
    for begin in range(0, len(rows), ROWS):
        stacked = np.vstack([triangle, rows[begin : begin + ROWS]])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
    return triangle


def least_squares(blocks: Iterable[Array], unit: Array, rcond: float) -> tuple[Array, float]:
    """(x (p,) that solves A x = b, norm of A x − b); x is of least norm in units (p,), rows [A | b] come in blocks.

    A direction with less than `rcond` of the largest singular value in those units is left at zero.
    """
    triangle = np.zeros((0, len(unit) + 1))
    for rows in blocks:
        triangle = fold(triangle, rows)
    solution: Array = unit * np.linalg.lstsq(triangle[:, :-1] * unit, triangle[:, -1], rcond=rcond)[0]
    return solution, float(np.linalg.norm(triangle[:, :-1] @ solution - triangle[:, -1]))
