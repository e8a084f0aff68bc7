"""Resampling of recorded channels: interpolation on an even time base, low pass, decimation."""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from armlink.errors import BadInput
from gcomp.arrays import Array

SLOW_HZ = 60.0
"""Below this rate [Hz] the recorded velocity is used; above, the position is differentiated, for drives report velocity
late."""
STEP_RATIO = 3.5
"""Largest ratio of a step between readings to the median step for interpolation by splines."""


def interpolate_even(t: Array, values: Array, even: Array, label: str, column: str) -> Array:
    """Values on the even time base, by cubic splines for a channel that is slow and even, else linear.

    Raises BadInput if a whole column is missing.
    """
    out = np.empty((len(even), values.shape[1]))
    for j in range(values.shape[1]):
        there = np.isfinite(values[:, j])
        if there.sum() < 4 or (column == "q" and there.mean() < 0.2):
            raise BadInput(
                f"{label}: column {column}_{j + 1} holds only {int(there.sum())} numbers in {len(t)} rows: "
                "record a reading in most rows, or leave this channel out"
            )
        own = t[there]
        steps, usual = np.diff(own), float(np.median(np.diff(own)))
        even_enough = steps.max() < STEP_RATIO * usual and steps.min() > usual / STEP_RATIO and usual > 1.0 / SLOW_HZ
        curve = CubicSpline(own, values[there, j]) if even_enough else None
        inside = np.clip(even, own[0], own[-1])
        out[:, j] = np.interp(inside, own, values[there, j]) if curve is None else curve(inside)
    return out


def coverage(t: Array, values: Array, even: Array) -> Array:
    """1 if a reading is within a few of the channel's own periods, (K, n)."""
    out = np.zeros((len(even), values.shape[1]))
    for j in range(values.shape[1]):
        there = t[np.isfinite(values[:, j])]
        after = np.clip(np.searchsorted(there, even), 1, len(there) - 1)
        gap = there[after] - there[after - 1]
        out[:, j] = gap <= max(6.0 * float(np.median(np.diff(there))), 0.05)
    return out


def decimation(rate: float, stride: int) -> Callable[[Array], Array]:
    """Decimation by `stride` of a signal at `rate` [Hz], after a low pass."""
    if stride == 1:
        return lambda x: x
    low = low_pass(0.4 * rate / stride, rate)
    return lambda x: low(x)[::stride]


def low_pass(cut: float, rate: float) -> Callable[[Array], Array]:
    """Zero-phase low pass (4th-order Butterworth) at `cut` of signals at `rate` [Hz], along the first axis."""
    sections = butter(4, cut, fs=rate, output="sos")
    return lambda x: np.asarray(sosfiltfilt(sections, x, axis=0))
