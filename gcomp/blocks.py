"""Least squares on many rows in little memory: the triangular factor, updated some rows at a time."""

from collections.abc import Iterable

import numpy as np

from gcomp.arrays import Array

ROWS = 192
"""Rows folded in at a time. So small a factorisation stays in the cache and on one thread: on a busy machine a
threaded one is a hundred times slower than this."""


def fold(triangle: Array, rows: Array) -> Array:
    """Triangular factor (p, p) of everything folded in so far and the rows (K, p)."""
    for begin in range(0, len(rows), ROWS):
        stacked = np.vstack([triangle, rows[begin : begin + ROWS]])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
    return triangle


def least_squares(blocks: Iterable[Array], size: int, rcond: float) -> Array:
    """x (p,) of least norm that solves A x = b, from blocks of rows [A | b] (K, p + 1); columns are scaled alike."""
    triangle = np.zeros((0, size + 1))
    for rows in blocks:
        triangle = fold(triangle, rows)
    scale = np.linalg.norm(triangle[:, :-1], axis=0)
    scale[scale == 0] = 1.0
    solution: Array = np.linalg.lstsq(triangle[:, :-1] / scale, triangle[:, -1], rcond=rcond)[0] / scale
    return solution
