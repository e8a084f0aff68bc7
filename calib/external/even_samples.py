"""Recordings as evenly spaced samples."""

from collections.abc import Sequence

import numpy as np

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from gcomp.external.external_model import ROWS_RATE
from gcomp.external.filtered_rows import Samples

FASTEST = 250.0
"""Samples a second at most [Hz]: ten a row."""
LONGEST_GAP = 0.3
"""Between two rows of a recording [s]; a longer one parts it in two."""
SHORTEST = 1.0
"""Of a part [s] that counts."""


def averaged_samples(t: Array, rate: float) -> int:
    """How many samples at times (K,) [s] go into a value at `rate` [Hz]: all of its period, to the 2 % that clocks are
    apart."""
    return max(1, int(1.02 / (rate * float(np.median(np.diff(t))))))


def rate_of(recordings: Sequence[Recording]) -> float:
    """The rate at which all of them are sampled [Hz], a multiple of the rows' rate. Raises BadInput if too slow."""
    slowest = min(1.0 / float(np.median(np.diff(each.t))) for each in recordings)
    if slowest < 0.8 * ROWS_RATE:
        raise BadInput(f"the slowest recording has {slowest:.1f} rows a second, expected at least {ROWS_RATE:g}")
    return ROWS_RATE * max(1, round(min(slowest, FASTEST) / ROWS_RATE))


def even_samples(
    recording: Recording, channel: str, rate: float, warm: Array | None = None
) -> list[tuple[Array, Samples]]:
    """Times [s] and samples of each part without a gap; `warm` (n,) [°C] is the temperature that counts as none."""
    torque = getattr(recording, channel)
    known = np.isfinite(recording.position).all(1) & np.isfinite(torque).all(1)
    t = recording.t[known]
    velocity = recording.velocity
    if velocity is None or not np.isfinite(velocity[known]).all():
        velocity = None
    parts, cuts = [], np.flatnonzero(np.diff(t) > LONGEST_GAP) + 1
    for index in np.split(np.arange(len(t)), cuts):
        if len(index) < 2 or t[index[-1]] - t[index[0]] < SHORTEST:
            continue
        even = np.arange(t[index[0]], t[index[-1]], 1.0 / rate)
        q = _resampled(even, t[index], recording.position[known][index], rate)
        v = np.gradient(q, 1.0 / rate, axis=0)
        if velocity is not None:
            v = _resampled(even, t[index], velocity[known][index], rate)
        warmth = np.zeros_like(q)
        if warm is not None and recording.temperature is not None:
            warmth = np.nan_to_num(_resampled(even, t[index], recording.temperature[known][index], rate) - warm)
        parts.append((even, Samples(q, v, _resampled(even, t[index], torque[known][index], rate), warmth)))
    return parts


def _resampled(even: Array, t: Array, values: Array, rate: float) -> Array:
    """Means over a period where the recording is faster, else straight lines between its rows."""
    count = averaged_samples(t, rate)
    if count >= 2:
        kernel = np.ones(count) / count
        pad = np.pad(values, ((count // 2, count - 1 - count // 2), (0, 0)), mode="edge")
        values = np.stack([np.convolve(column, kernel, mode="valid") for column in pad.T], axis=1)
    return np.stack([np.interp(even, t, column) for column in values.T], axis=1)
