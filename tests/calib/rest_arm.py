"""An arm that works from rest to rest, one row a rest, with a torque that no model has; for the observer."""

from collections.abc import Callable

import numpy as np
from fast_arm import NOISE_SHARE, FastArm

from armlink.arm_file import ArmFile
from calib.motion.static_reading import StaticReading
from calib.observer.decision import Event
from calib.observer.observer import Observer
from gcomp.gravity.torque import gravity_regressor

SAMPLES = 75
"""Samples of 250 Hz in the average of one rest."""
TERMS = 4


def harmonics(arm: FastArm, share: float, random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Torque (K, n) [N·m] of `share` of rated torque (standard deviation), smooth in a joint's and the next angles."""
    n = arm.n
    terms = []
    for j in range(n):
        for _ in range(random.integers(2, TERMS + 1)):
            frequency = np.zeros(n)
            frequency[j] = random.integers(1, 4)
            for k in (j - 1, j + 1):
                if 0 <= k < n:
                    frequency[k] = random.integers(-1, 2)
            terms.append((j, frequency, random.uniform(0, 2 * np.pi), random.normal()))

    def shape(q: np.ndarray) -> np.ndarray:
        torque = np.zeros_like(q)
        for j, frequency, phase, size in terms:
            torque[:, j] += size * np.sin(q @ frequency + phase)
        return torque

    poses = np.random.default_rng(1).uniform(arm.arm.lower, arm.arm.upper, (2000, n))
    typical = shape(poses).std(axis=0)
    return lambda q: share * arm.rated * shape(q) / typical


class RestArm(FastArm):
    """As the fast arm, but only its rests; `lacking` is what the model lacks, (q, side) → torque (K, n) [N·m]."""

    def __init__(self, arm: str | ArmFile = "sarcos", seed: int = 0) -> None:
        super().__init__(arm, seed)
        self.lacking: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda q, side: np.zeros_like(q)
        self.temperature = np.full(self.n, np.nan)
        """That the drives tell (n,) [°C]."""

    def row(self) -> StaticReading:
        """Move to another waypoint, and rest there."""
        motion, middle = self.motion, (self.arm.lower + self.arm.upper) / 2
        half = np.maximum((self.arm.upper - self.arm.lower) / 2 - motion.margin, 0.0)
        nearest, farthest = (
            np.maximum(middle - half, self.q - motion.reach),
            np.minimum(middle + half, self.q + motion.reach),
        )
        goal = self.random.uniform(np.minimum(nearest, farthest), np.maximum(nearest, farthest))
        if self.job is not None:
            goal = next(self.job)
        step = goal - self.q
        way = np.abs(step) / (motion.speed_share * self.speed) + motion.speed_share * self.speed / motion.acceleration
        way = np.maximum(way, 0.0)
        short = 2 * np.sqrt(np.abs(step) / motion.acceleration)
        fast = np.abs(step) > (motion.speed_share * self.speed) ** 2 / motion.acceleration
        self.t += float(np.where(fast, way, short).max()) + motion.rest
        self.q = goal
        side = np.sign(step)
        noise = NOISE_SHARE * self.rated / np.sqrt(SAMPLES)
        raw = self.gain * self.scale * self.reading(goal, side) + self.offset + noise * self.random.normal(size=self.n)
        reading = (raw - self.held_offset) / self.held_gain
        error = np.abs(noise * self.random.normal(size=self.n))
        return StaticReading.of(self.t, goal, reading, side, torque_error=error, temperature=self.temperature)

    def reading(self, q: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Torque (n,) [N·m] that ideal sensors read at a pose (n,) [rad] approached from sides (n,)."""
        torque = (gravity_regressor(self.arm, q[None]) @ (self.beta + self.load) + self.lacking(q[None], side[None]))[0]
        return torque if self.push is None else torque + self.push(q[None])[0]

    def work(self, observer: Observer, rows: int, apply: bool = True) -> list[Event]:
        """So many rests; with `apply` every proposal is written at once. Returns the events."""
        said = []
        for _ in range(rows):
            for event in observer.handle_row(self.row()):
                said.append(event)
                if event.finding is not None and apply:
                    self.install(event.finding.joint, event.finding.gain, event.finding.offset)
                    observer.install(event.finding)
        return said
