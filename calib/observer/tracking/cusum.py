"""Change detection: log-likelihood CUSUM per joint on the residual against the installed calibration."""

from typing import Any

import numpy as np

from calib.observer.config import ObserverConfig
from gcomp.arrays import Array, as_array

CHANNELS = ("gain up", "gain down", "offset up", "offset down")
ALARM_THRESHOLD = 10.0
"""Log-likelihood ratio of an alarm (docs/theory.md, section 6): one false alarm in 1.1e4 rows of a seven-joint arm,
which only starts a test."""


class Cusum:
    """Four channels per joint, h ∈ {±δ_k τ, ±δ_o}: S ← max(0, S + (h e − h²/2)/R), alarm above the threshold.

    The residual e is taken against the installed calibration, because the innovations of a tracking filter would hide
    slow drift (docs/theory.md, section 6).
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._config = config
        self._sums: Array = np.zeros((n, len(CHANNELS)))
        self._rising = np.zeros((n, len(CHANNELS)), dtype=int)

    def handle(self, residual: Array, torque: Array, variance: Array) -> list[tuple[int, str]]:
        """Update with one row; returns joints and channels in alarm.

        residual and model torque (n,) [N·m], variance of the residual (n,) [N²·m²].
        """
        gain = self._config.alarm_gain * torque
        offset = np.full_like(torque, self._config.alarm_offset)
        change = np.stack([gain, -gain, offset, -offset], axis=1)
        ratio = (change * residual[:, None] - change**2 / 2) / variance[:, None]
        self._sums = np.maximum(0.0, self._sums + ratio)
        self._rising = np.where(self._sums > 0.0, self._rising + 1, 0)
        return [(int(j), CHANNELS[c]) for j, c in np.argwhere(self._sums > ALARM_THRESHOLD)]

    def reset(self) -> None:
        self._sums, self._rising = np.zeros_like(self._sums), np.zeros_like(self._rising)

    def rising(self, joint: int, channel: str) -> int:
        """Rows since a channel's sum was last 0, at least 1."""
        return max(1, int(self._rising[joint, CHANNELS.index(channel)]))

    def drop(self, joint: int, channel: str) -> None:
        """Set one channel's sum to zero: the model's own error has raised it."""
        at = joint, CHANNELS.index(channel)
        self._sums[at], self._rising[at] = 0.0, 0

    def save(self) -> dict[str, Any]:
        """The sums and how long they have been rising, as JSON values."""
        return {"sums": self._sums.tolist(), "rising": self._rising.tolist()}

    def restore(self, values: dict[str, Any]) -> None:
        shape, unknown = self._sums.shape, np.zeros_like(self._sums)
        self._sums = as_array("sums", values["sums"], shape)
        self._rising = as_array("rising", values.get("rising", unknown), shape).astype(int)
