"""Readings of a torque channel that say little: noise within the pass band, isolated spikes, and values that are stuck.

A late cycle of the host makes a position controller jump for a cycle or two. Whether that torque was real or misread, a
few samples of it say nothing about its mean, so that neither they nor their surroundings are compared with the model. A
reading that repeats to the last bit while the arm moves carries no information.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, median_filter
from scipy.signal import detrend

from gcomp.arrays import Array, Mask


def band_noise(t: Array, values: Array, band: float) -> float:
    """Noise within the pass band [N·m], from the channel's median spectrum above twice that band or just above it.

    The lower of the two: a controller's noise grows with frequency, and fast motion reaches beyond the band.
    """
    there = np.isfinite(values)
    x, own = values[there], t[there]
    if len(x) < 64:
        return 0.0
    rate = 1.0 / float(np.median(np.diff(own)))
    frequency, density = spectrum(x, rate)
    high = frequency > min(2.0 * band, 0.3 * rate)
    near = (frequency > 1.5 * band) & (frequency < 3.0 * band)
    levels = [float(np.median(density[part])) for part in (high, near) if part.any()]
    return float(np.sqrt(min(levels) / 0.69 * band)) if levels else 0.0


def spectrum(x: Array, rate: float) -> tuple[Array, Array]:
    """Frequencies [Hz] and power spectral density (Welch: Hann windows of 512 samples, overlapping by half, each
    detrended). As `scipy.signal.welch`, which takes the windows one by one and twenty times as long."""
    size = min(len(x), 512)
    window = np.hanning(size)
    pieces = detrend(np.lib.stride_tricks.sliding_window_view(x, size)[:: size // 2], axis=1)
    power = np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2
    density = 2.0 * power.mean(0) / (rate * (window @ window))
    return np.asarray(np.fft.rfftfreq(size, 1.0 / rate), float), np.asarray(density)


SLOWEST_HZ = 45.0
"""Rate below which a channel's single readings are no spikes: a motion of the arm may be as short."""
LONGEST_S, LONGEST = 0.015, 3
"""Longest spike, in seconds and in readings; one reading in any case."""
TIMES_USUAL, TIMES_LARGE, LARGE = 8.0, 6.0, 0.95
"""A spike departs from its surroundings by this many standard deviations of the usual departure (by its median), and by
this multiple of the departure that is exceeded in one reading of twenty."""
OF_SPAN = 0.05
"""A spike departs by this share of the channel's span or more."""
RARE = 0.01
"""Largest share of spikes; with more, they are the channel's noise."""
HELD = 0.6
"""Share of readings that differ from the one before, below which a channel holds each value for several rows."""
AROUND_S = 0.03
"""Time before and after a spike that is not compared either [s]."""
MOST = 0.2
"""Largest share of a joint's time that may be left out around spikes; with more, the spikes alone are."""


@dataclass(frozen=True)
class Spikes:
    """Number of spikes in one joint's channel, of how many readings."""

    channel: str
    joint: int
    count: int
    readings: int


def spikes_of(t: Array, values: Array) -> Mask:
    """Readings of a channel at times `t` (K,), NaN where there is none, that are isolated spikes, (K, n)."""
    return np.stack([_spikes(t, column) for column in values.T], axis=1)


def _spikes(t: Array, values: Array) -> Mask:
    out = np.zeros(len(values), bool)
    there = np.flatnonzero(np.isfinite(values))
    if len(there) < 100:
        return out
    changes = np.r_[0, np.flatnonzero(np.diff(values[there]) != 0.0) + 1]
    first = changes if len(changes) < HELD * len(there) else np.arange(len(there))
    if len(first) < 50:
        return out
    x, own = values[there[first]], t[there[first]]
    period = float(np.median(np.diff(own)))
    if period > 1.0 / SLOWEST_HZ:
        return out
    half = int(np.clip(LONGEST_S / period, 1, LONGEST))
    departure = np.abs(x - median_filter(x, 2 * half + 1, mode="nearest"))
    least = max(
        TIMES_USUAL * 1.4826 * float(np.median(departure)),
        TIMES_LARGE * float(np.quantile(departure, LARGE)),
        OF_SPAN * float(np.ptp(np.quantile(x, (0.02, 0.98)))),
    )
    lasting = np.diff(np.r_[own, t[there[-1]]])
    found = (departure > least) & (lasting < max(LONGEST_S, 3.0 * period))
    if not 0.0 < found.mean() <= RARE:
        return out
    last = np.r_[first[1:], len(there)]
    for k in np.flatnonzero(found).tolist():
        out[there[first[k] : last[k]]] = True
    return out


def are_near_spikes(t: Array, spikes: Sequence[Mask], times: Array) -> Mask:
    """Whether work times (k,) are near a spike of a joint in any of its channels, (k, n).

    `spikes` are those of each channel at times `t`, (K, n) each. Joints that would lose too much time lose none.
    """
    near = np.zeros((len(times), spikes[0].shape[1]), bool)
    width = round(AROUND_S / float(times[1] - times[0]))
    for joint in range(near.shape[1]):
        at = t[np.any([mask[:, joint] for mask in spikes], axis=0)]
        if len(at):
            near[np.clip(np.searchsorted(times, at), 0, len(times) - 1), joint] = True
            near[:, joint] = binary_dilation(near[:, joint], iterations=width) if width else near[:, joint]
    return np.asarray(near & (near.mean(0) <= MOST))


def count_spikes(spikes: Mapping[str, Mask], channels: Mapping[str, Array | None]) -> tuple[Spikes, ...]:
    """Numbers of spikes of each channel and joint that has any."""
    return tuple(
        Spikes(channel, int(joint), int(mask[:, joint].sum()), int(np.isfinite(values[:, joint]).sum()))
        for channel, mask in spikes.items()
        if (values := channels[channel]) is not None
        for joint in np.flatnonzero(mask.any(0))
    )


LONGEST_STUCK_S = 2.0
"""Longest time for which a reading may repeat [s]."""
MOVED, STEPS = 0.1, 2.0
"""Least change of the model torque meanwhile: as a share of its range, and in least steps of the reading, one of which
it may not see; the other is for the model's error."""


@dataclass(frozen=True)
class Stuck:
    """One joint's stuck channel, and for how long in total."""

    channel: str
    joint: int
    seconds: float


def stuck_intervals(time: Array, model: Array, held: Mask, t: Array, reading: Array) -> list[tuple[float, float]]:
    """Intervals of time [s] in which a joint's reading repeats although its torque changes.

    `model` is the nominal torque [N·m] at `time`, (K,); `reading` holds the finite values at `t`, (k,). At zero and at
    the largest reading it may repeat, as with a dead band and a clipped sensor. So may the motor of a joint that is
    `held` at rest, (K,): friction takes up the change.
    """
    changes = np.flatnonzero(np.diff(reading) != 0.0)
    starts, ends = np.r_[0, changes + 1], np.r_[changes, len(reading) - 1]
    out = []
    steps = np.diff(np.unique(reading))
    least = max(MOVED * float(np.ptp(model)), STEPS * float(steps.min()) if len(steps) else 0.0)
    long = t[ends] - t[starts] >= LONGEST_STUCK_S
    for a, b in zip(starts[long].tolist(), ends[long].tolist(), strict=True):
        natural = len(changes) > 0 and (reading[a] == 0.0 or abs(reading[a]) >= np.abs(reading).max())
        meanwhile = (time >= t[a]) & (time <= t[b]) & ~held
        if not natural and meanwhile.any() and np.ptp(model[meanwhile]) > least:
            out.append((float(t[a]), float(t[b])))
    return out


@dataclass(frozen=True)
class Disturbance:
    """One disturbance: its time since the start of the recording [s], the largest residual [N·m] and its joint."""

    start: float
    end: float
    joint: int
    torque: float
