"""Recursive estimate of every joint's torque gain and offset, relative to what is installed."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.observer.config import ObserverConfig
from gcomp.arrays import Array, as_array


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
        self._initial = np.diag([config.initial_gain_std**2, config.initial_offset_std**2])
        self.covariance: Array = np.tile(self._initial, (n, 1, 1))
        """Of gain and offset (n, 2, 2)."""
        self.accepted = np.zeros(n, dtype=int)
        """Rows that went into each joint's estimate (n,)."""
        self.rejected = np.zeros(n, dtype=int)
        """Consecutive rows rejected as outliers (n,)."""
        self._recent: deque[Array] = deque(maxlen=config.longest_window)

    def handle(self, reading: Array, torque: Array, variance: Array) -> None:
        """Update with one row: reading and model torque (n,) [N·m], variance of their difference (n,) [N²·m²]."""
        config = self._config
        self._recent.append(torque)
        spread = len(self._recent) * np.var(np.array(self._recent), axis=0)
        excited = spread * config.gain_std**2 >= variance
        for j in range(len(self.state)):
            self._update(j, reading[j], np.array([torque[j], 1.0]), variance[j], bool(excited[j]))

    def _update(self, j: int, reading: float, h: Array, variance: float, excited: bool) -> None:
        config = self._config
        walk = np.diag([config.drift_gain**2 if excited else 0.0, config.drift_offset**2])
        predicted = self.covariance[j] + walk
        of_innovation = h @ predicted @ h + variance
        innovation = reading - h @ self.state[j]
        if innovation**2 > config.outlier * of_innovation:
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
