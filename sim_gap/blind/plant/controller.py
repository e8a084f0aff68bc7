"""The joints' position controllers: PID with feed-forward, on quantised and noisy readings."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.cases.motion import RATE
from sim_gap.blind.plant.friction import padded
from sim_gap.blind.plant.runs import Run

BLOCK = 256
VELOCITY_HZ = 40.0
"""Low pass of the controller's velocity [Hz]."""
DAMPING_RATIO = 0.9
INTEGRAL_S = 1.5


class Controller:
    """Torque commands for many arms at `motion.RATE`, (k, width)."""

    def __init__(self, runs: Sequence[Run], reading: Array, width: int) -> None:
        """`reading` (B, width): initial readings [rad]."""
        self.runs = runs
        inertia = padded([run.inertia for run in runs], width)
        omega = padded([run.truth.bandwidth for run in runs], width)
        self.stiffness, self.damping = inertia * omega**2, 2 * DAMPING_RATIO * inertia * omega
        self.integral = self.stiffness / INTEGRAL_S
        self.resolution = np.array([[run.truth.encoder_step] for run in runs])
        self.random = [np.random.default_rng([run.seed, 1]) for run in runs]
        self.smooth = 1.0 - np.exp(-2 * np.pi * VELOCITY_HZ / RATE)
        self.before = reading.copy()
        self.velocity, self.error_sum = np.zeros_like(reading), np.zeros_like(reading)
        self.position, self.speed, self.feed, self.noise = (np.zeros((BLOCK, len(runs), width)) for _ in range(4))

    def command(self, tick: int, reading: Array) -> Array:
        """Torques [N·m] of the first k arms from their exact readings."""
        k, row = len(reading), tick % BLOCK
        if row == 0:
            self._load(tick, k)
        step = self.resolution[:k]
        seen = np.rint(reading / step + self.noise[row, :k]) * step
        velocity = self.velocity[:k]
        velocity += self.smooth * ((seen - self.before[:k]) * RATE - velocity)
        self.before[:k] = seen
        error = self.position[row, :k] - seen
        self.error_sum[:k] += error / RATE
        torque = self.feed[row, :k] + self.stiffness[:k] * error + self.damping[:k] * (self.speed[row, :k] - velocity)
        return np.asarray(torque + self.integral[:k] * self.error_sum[:k])

    def _load(self, tick: int, k: int) -> None:
        """Load the next block of every trajectory and of the sensors' noise (0.4 counts)."""
        for b, run in enumerate(self.runs[:k]):
            n, rows = run.truth.n, min(BLOCK, len(run.command) - tick)
            part = run.command[max(tick - 1, 0) : tick + rows]
            speed = np.diff(part, axis=0, prepend=part[:1])[-rows:] * RATE
            self.position[:rows, b, :n], self.speed[:rows, b, :n] = run.command[tick : tick + rows], speed
            self.feed[:rows, b, :n] = run.feed_forward[tick : tick + rows]
            self.noise[:, b, :n] = 0.4 * self.random[b].standard_normal((BLOCK, n))
