"""Change detection: log-likelihood CUSUM per joint on the residual against the installed calibration."""

import numpy as np

from calib.observer.config import ObserverConfig
from calib.records.records import Array

CHANNELS = ("gain up", "gain down", "offset up", "offset down")


class Cusum:
    """Four channels a joint, h ∈ {±δ_k τ, ±δ_o}: S ← max(0, S + (h e − h²/2)/R), an alarm above the threshold.

    The residual e is that against the installed calibration: innovations of a tracking filter would hide slow drift.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints."""
        self._config = config
        self.sums: Array = np.zeros((n, len(CHANNELS)))

    def handle(self, residual: Array, torque: Array, variance: Array) -> list[tuple[int, str]]:
        """One row: residual, model torque (n,) [N·m], variance of the residual (n,); joints and channels in alarm."""
        gain = self._config.alarm_gain * torque
        offset = np.full_like(torque, self._config.alarm_offset)
        change = np.stack([gain, -gain, offset, -offset], axis=1)
        ratio = (change * residual[:, None] - change**2 / 2) / variance[:, None]
        self.sums = np.maximum(0.0, self.sums + ratio)
        return [(int(j), CHANNELS[c]) for j, c in np.argwhere(self.sums > self._config.alarm_threshold)]

    def reset(self) -> None:
        """Start again from nothing."""
        self.sums[:] = 0.0
