"""The observer on synthetic stops of an arm whose sensors drift as told."""

from collections.abc import Callable

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.config import ObserverConfig
from calib.observer.decision import Event
from calib.observer.observer import Observer
from gcomp.arm.arm import Arm
from gcomp.gravity.torque import gravity_torque

SIGMA = np.array([0.04, 0.04, 0.02, 0.02, 0.01, 0.01, 0.004])
"""Torque noise of 0.2 % of rated torque, averaged over 0.2 s at 250 Hz."""
MODEL_STD = np.repeat([4.4, 4.5, 1.3, 0.9, 0.5, 0.4, 0.3], 2) * 1e-3
POSE_SECONDS = 2.0


class Bench:
    """An arm whose sensors drift as told; recalibrates at every proposal, as the policy `apply` does."""

    def __init__(self, arm: Arm, beta: np.ndarray, seed: int, config: ObserverConfig | None = None) -> None:
        self.arm, self.beta, self.random = arm, beta, np.random.default_rng(seed)
        scale = 1 + 3e-3 * self.random.normal()  # common to calibration and model: nobody can see it
        covariance = np.diag(MODEL_STD**2) + 9e-6 * np.outer(beta, beta)
        model = (beta + MODEL_STD * self.random.normal(size=beta.size)) * scale
        self.observer = Observer.at_rest(arm, model, covariance, SIGMA, config)
        self.scale = scale
        self.gain, self.offset = np.ones(arm.n), np.zeros(arm.n)
        """Of the readings as installed."""
        self.extra: Callable[[np.ndarray], np.ndarray] = lambda q: np.zeros(arm.n)
        self.directions = (-1.0, 1.0)
        self.t = 0.0
        self.events: list[Event] = []

    def drift(self, joint: int, gain: float = 1.0, offset: float = 0.0) -> None:
        self.gain[joint] *= gain
        self.offset[joint] = self.offset[joint] * gain + offset

    def work(self, poses: int, apply: bool = True) -> list[Event]:
        """Random stops; returns their events."""
        said: list[Event] = []
        for _ in range(poses):
            q = self.random.uniform(self.arm.lower, self.arm.upper)
            torque = gravity_torque(self.arm, self.beta, q) + self.extra(q)
            reading = self.gain * self.scale * torque + self.offset + SIGMA * self.random.normal(size=self.arm.n)
            events = self.observer.handle_row(
                StaticReading.of(self.t, q, reading, self.random.choice(self.directions, self.arm.n))
            )
            for event in events:
                if event.finding and apply:
                    j = event.finding.joint
                    self.gain[j] /= event.finding.gain
                    self.offset[j] = (self.offset[j] - event.finding.offset) / event.finding.gain
                    self.observer.install(event.finding)
            said += events
            self.t += POSE_SECONDS
        self.events += said
        return said

    def error(self, joint: int) -> tuple[float, float]:
        """What is left of gain and offset error against the calibration before the drift."""
        return abs(self.gain[joint] - 1), abs(self.offset[joint])


def kinds(events: list[Event]) -> list[str]:
    return [event.kind for event in events]
