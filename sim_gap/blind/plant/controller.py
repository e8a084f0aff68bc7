"""Controllers of the joints: PID with feed-forward on quantised and noisy readings, and position servos.

A servo has a law of its own on every joint, and a finer encoder than is recorded.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant.drive import pad_rows
from sim_gap.blind.true_arm import PlantRun

BLOCK = 256
VELOCITY_HZ, SERVO_VELOCITY_HZ = 40.0, 200.0
"""Low pass of the velocity in a PID controller, and in a servo [Hz]."""
INTEGRAL_S = 1.5
"""Stiffness over integral gain [s]."""
DAMPING_RATIO = 0.9


class PidControllers:
    """Torque commands for many arms at `motion.RATE`, (k, width)."""

    def __init__(self, runs: Sequence[PlantRun], reading: Array, width: int) -> None:
        """`reading` (B, width): initial readings [rad]."""
        self.runs = runs
        inertia = pad_rows([run.inertia for run in runs], width)
        omega = pad_rows([run.truth.bandwidth for run in runs], width)
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


FINE = 1e-6
"""Resolution of the servo's own position [rad]."""


@dataclass(eq=False)
class ServoLaw:
    """u = stiffness·e − damping·q̇ + integral·∫e of a command that is late, slew-limited and has a dead zone; (n,) each.

    SI units; the motor's torque limit and back-EMF belong to the arm.
    """

    stiffness: Array
    damping: Array
    integral: Array
    delay: Array
    slew: Array
    dead: Array
    """Half width of the dead zone [rad]."""


@dataclass(frozen=True)
class ServoRun(PlantRun):
    law: ServoLaw


class Servos:
    """Torque commands of many arms at `motion.RATE`."""

    def __init__(self, runs: Sequence[PlantRun], reading: Array, width: int) -> None:
        """`reading` (B, width): initial readings [rad]."""
        self.runs = runs
        laws = [run.law for run in runs if isinstance(run, ServoRun)]
        self.stiffness, self.damping, self.integral, self.dead = (
            pad_rows([getattr(law, name) for law in laws], width)
            for name in ("stiffness", "damping", "integral", "dead")
        )
        self.step = pad_rows([law.slew for law in laws], width, np.inf) / RATE
        self.late = pad_rows([law.delay for law in laws], width) * RATE
        self.smooth = 1.0 - np.exp(-2 * np.pi * SERVO_VELOCITY_HZ / RATE)
        self.before, self.target = reading.copy(), reading.copy()
        self.velocity, self.error_sum = np.zeros_like(reading), np.zeros_like(reading)

    def command(self, tick: int, reading: Array) -> Array:
        """Torques [N·m] of the first k arms from their exact readings."""
        k = len(reading)
        seen = np.rint(reading / FINE) * FINE
        self.velocity[:k] += self.smooth * ((seen - self.before[:k]) * RATE - self.velocity[:k])
        self.before[:k] = seen
        self.target[:k] += np.clip(self._wanted(tick, k) - self.target[:k], -self.step[:k], self.step[:k])
        error = self.target[:k] - seen
        error = np.sign(error) * np.maximum(np.abs(error) - self.dead[:k], 0.0)
        self.error_sum[:k] += error / RATE
        torque = self.stiffness[:k] * error - self.damping[:k] * self.velocity[:k]
        return np.asarray(torque + self.integral[:k] * self.error_sum[:k])

    def _wanted(self, tick: int, k: int) -> Array:
        """Commands as they arrive: late by a number of ticks that need not be whole."""
        out = np.zeros((k, self.late.shape[1]))
        for b, run in enumerate(self.runs[:k]):
            joints = np.arange(run.truth.n)
            due = np.clip(tick - self.late[b, joints], 0.0, len(run.command) - 1)
            whole = due.astype(int)
            part = due - whole
            ahead = np.minimum(whole + 1, len(run.command) - 1)
            out[b, joints] = run.command[whole, joints] * (1.0 - part) + run.command[ahead, joints] * part
        return out
