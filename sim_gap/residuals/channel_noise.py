"""Noise of a recorded channel within the pass band of the comparison."""

import numpy as np

from gcomp.arrays import Array


def band_noise(t: Array, values: Array, band: float) -> float:
    """Noise within the pass band [N·m], from the channel's median spectrum above twice that band or just above it.

    The lower of the two: a controller's noise grows with frequency, and fast motion reaches beyond the band.
    """
    there = np.isfinite(values)
    x, own = values[there], t[there]
    if len(x) < 64:
        return 0.0
    rate = 1.0 / float(np.median(np.diff(own)))
    frequency, density = spectrum(x - x.mean(), rate)
    high = frequency > min(2.0 * band, 0.3 * rate)
    near = (frequency > 1.5 * band) & (frequency < 3.0 * band)
    levels = [float(np.median(density[part])) for part in (high, near) if part.any()]
    return float(np.sqrt(min(levels) / 0.69 * band)) if levels else 0.0


def spectrum(x: Array, rate: float) -> tuple[Array, Array]:
    """Power spectral density (Welch: Hann windows of 512 samples, overlapping by half, each detrended)."""
    size = min(len(x), 512)
    pieces = np.lib.stride_tricks.sliding_window_view(x, size)[:: size // 2]
    line = np.linspace(-1.0, 1.0, size)
    pieces = pieces - pieces.mean(1, keepdims=True)
    pieces = pieces - (pieces @ line / (line @ line))[:, None] * line
    window = np.hanning(size)
    power = np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2
    density = 2.0 * power.mean(0) / (rate * (window @ window))
    return np.asarray(np.fft.rfftfreq(size, 1.0 / rate), float), np.asarray(density)
