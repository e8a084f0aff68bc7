"""Recursive estimate of every joint's torque gain and offset, relative to what is installed."""

from collections import deque

import numpy as np

from calib.observer.config import ObserverConfig
from calib.records.records import Array


class SensorFilter:
    """A Kalman filter a joint, state (gain, offset) as a random walk: reading = gain·τ + offset (theory.md section 6).

    Relative to the installed calibration: (1, 0) while that is right.
    """

    def __init__(self, n: int, config: ObserverConfig) -> None:
        """n joints, each believed to be as installed."""
        self._config = config
        self.state: Array = np.tile([1.0, 0.0], (n, 1))
        """(n, 2): gain and offset."""
        initial = np.diag([config.initial_gain_std**2, config.initial_offset_std**2])
        self.covariance: Array = np.tile(initial, (n, 1, 1))
        """(n, 2, 2)"""
        self.accepted = np.zeros(n, dtype=int)
        self.rejected = np.zeros(n, dtype=int)
        """Rows rejected in a row."""
        self.recent: deque[Array] = deque(maxlen=config.excitation_rows)

    def handle(self, reading: Array, torque: Array, variance: Array) -> None:
        """One row: reading and model torque (n,) [N·m], variance of their difference (n,)."""
        config = self._config
        self.recent.append(torque)
        spread = len(self.recent) * np.var(np.array(self.recent), axis=0)
        excited = spread * config.excitation_std**2 >= variance
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
            weight[0] = 0.0  # gain is carried with its uncertainty, not updated
        keep = np.eye(2) - np.outer(weight, h)
        self.state[j] += weight * innovation
        self.covariance[j] = keep @ predicted @ keep.T + np.outer(weight, weight) * variance
        self.accepted[j] += 1
        self.rejected[j] = 0

    def restart(self, j: int, gain: float = 1.0, offset: float = 0.0, covariance: Array | None = None) -> None:
        """Set what is known of joint j anew; by default that it is as installed, with covariance (2, 2)."""
        config = self._config
        initial = np.diag([config.initial_gain_std**2, config.initial_offset_std**2])
        self.state[j] = (gain, offset)
        self.covariance[j] = initial if covariance is None else covariance
        self.rejected[j] = 0
