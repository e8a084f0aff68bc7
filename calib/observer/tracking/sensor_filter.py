"""Recursive estimate of every joint's torque gain and offset, relative to what is installed."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD, LONGEST_WINDOW, ObserverConfig
from gcomp.arrays import Array, as_array

GAIN_WALK = 1e-4
"""Random walk of the gain per accepted row (docs/theory.md, section 6): steady-state √(q σ/τ_rms) is 0.05 % for a joint
loaded with 10 N·m."""
OFFSET_WALK = 2e-3
"""Random walk of the offset per accepted row [N·m] (likewise): steady-state √(q σ) is 0.01 N·m at σ = 0.05 N·m."""
OUTLIER = 10.8
"""A row is rejected if its squared innovation over the variance is larger: noise exceeds this χ², with 1 degree of
freedom, once in 1000."""


@dataclass(frozen=True)
class Estimate:
    """Gain and offset of every joint against the installed calibration, with standard deviations; (n,) each."""

    gain: Array
    gain_std: Array
    offset: Array
    """[N·m]"""
    offset_std: Array
    accepted: Array
    """Rows that went into each."""


class SensorFilter:
    """One Kalman filter per joint; its state (gain, offset) is a random walk: reading = gain·τ + offset.

    Relative to the installed calibration: (1, 0) while that is right. Equations: docs/theory.md, section 6.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints, each assumed to be as installed."""
        self._config = config
        self.state: Array = np.tile([1.0, 0.0], (n, 1))
        """Gain and offset [N·m] (n, 2)."""
        self._initial = np.diag([INITIAL_GAIN_STD**2, INITIAL_OFFSET_STD**2])
        self.covariance: Array = np.tile(self._initial, (n, 1, 1))
        """Of gain and offset (n, 2, 2)."""
        self.accepted = np.zeros(n, dtype=int)
        """Rows that went into each joint's estimate (n,)."""
        self.rejected = np.zeros(n, dtype=int)
        """Consecutive rows rejected as outliers (n,)."""
        self._recent: deque[Array] = deque(maxlen=LONGEST_WINDOW)

    def handle(self, reading: Array, torque: Array, variance: Array) -> None:
        """Update with one row: reading and model torque (n,) [N·m], variance of their difference (n,) [N²·m²]."""
        self._recent.append(torque)
        spread = len(self._recent) * np.var(np.array(self._recent), axis=0)
        excited = spread * self._config.gain_std**2 >= variance
        for j in range(len(self.state)):
            self._update(j, reading[j], np.array([torque[j], 1.0]), variance[j], bool(excited[j]))

    def _update(self, j: int, reading: float, h: Array, variance: float, excited: bool) -> None:
        walk = np.diag([GAIN_WALK**2 if excited else 0.0, OFFSET_WALK**2])
        predicted = self.covariance[j] + walk
        of_innovation = h @ predicted @ h + variance
        innovation = reading - h @ self.state[j]
        if innovation**2 > OUTLIER * of_innovation:
            self.rejected[j] += 1
            return
        weight = predicted @ h / of_innovation
        if not excited:
            weight[0] = 0.0  # the gain keeps its value and uncertainty
        keep = np.eye(2) - np.outer(weight, h)
        self.state[j] += weight * innovation
        self.covariance[j] = keep @ predicted @ keep.T + np.outer(weight, weight) * variance
        self.accepted[j] += 1
        self.rejected[j] = 0

    def restart(self, j: int, gain: float = 1.0, offset: float = 0.0, covariance: Array | None = None) -> None:
        """Reset joint j to these values and covariance (2, 2); by default to "as installed"."""
        self.state[j] = (gain, offset)
        self.covariance[j] = self._initial if covariance is None else covariance
        self.rejected[j] = 0

    def estimate(self) -> Estimate:
        gain_std, offset_std = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)).T
        gain, offset = self.state.T.copy()
        return Estimate(gain, gain_std, offset, offset_std, self.accepted.copy())

    def save(self) -> dict[str, Any]:
        """State, covariance, counters and the recent model torques, as JSON values."""
        arrays = {name: getattr(self, name).tolist() for name in ("state", "covariance", "accepted", "rejected")}
        return {**arrays, "recent": [torque.tolist() for torque in self._recent]}

    def restore(self, values: dict[str, Any]) -> None:
        n = len(self.state)
        self.state = as_array("state", values["state"], (n, 2))
        self.covariance = as_array("covariance", values["covariance"], (n, 2, 2))
        self.accepted, self.rejected = (
            as_array(key, values[key], (n,)).astype(int) for key in ("accepted", "rejected")
        )
        recent = [as_array("recent", torque, (n,)) for torque in values["recent"]]
        self._recent = deque(recent, maxlen=self._recent.maxlen)
