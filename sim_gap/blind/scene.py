"""A nominal arm along its commanded training motion, for choosing magnitudes of effects that show."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, compile_arm, controlled_inertia, inverse, mass_matrices
from sim_gap.blind.motion import RATE, derivatives

SENSOR_LEAST, MOTOR_LEAST = 0.12, 0.3
"""Least RMS that an effect causes in its channel [N·m], for every torque."""
SHARES = (0.06, 0.14)
"""RMS that an effect causes, as a share of the joint's RMS torque: several times that of small background errors."""
LEAST_SPEED = 0.02
"""Speed below which friction is undetermined, and does not show in the readings [rad/s]."""
THIN = 25
"""Magnitudes are judged on every 25th row of the trajectory."""
THINNED_S = THIN / RATE


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
    dead_zone: Array
    """Half width [rad]."""


@dataclass(eq=False)
class Scene:
    """A nominal arm and its commanded training motion."""

    arm: BenchArm
    command: Array
    """(K, n) [rad] at `motion.RATE`."""
    law: ServoLaw | None = None
    """Of an arm with position servos."""

    @property
    def seconds(self) -> float:
        return len(self.command) / RATE

    @cached_property
    def model(self) -> Any:
        return compile_arm(self.arm)

    @cached_property
    def motion(self) -> tuple[Array, Array, Array]:
        """q, v, a of every `THIN`-th row."""
        v, a = derivatives(self.command)
        return self.command[::THIN], v[::THIN], a[::THIN]

    @cached_property
    def rotor_torque(self) -> Array:
        """Torque that accelerates the rotors (K', n) [N·m]."""
        return np.asarray(self.arm.armature * self.motion[2])

    @cached_property
    def torque(self) -> Array:
        """Link-side torque (K', n) [N·m]."""
        return inverse(self.model, *self.motion) - self.rotor_torque

    @property
    def motor_torque(self) -> Array:
        """Torque of the motors without friction (K', n) [N·m]."""
        return self.torque + self.rotor_torque

    @cached_property
    def gravity(self) -> Array:
        """Gravity torque (K', n) [N·m]."""
        q, v, _ = self.motion
        return inverse(self.model, q, 0 * v, 0 * v)

    @cached_property
    def rated(self) -> Array:
        """Rated torque of the drives: 1.5 times the peak torque of the motion, at least 3 N·m; (n,)."""
        return np.asarray(np.maximum(1.5 * np.abs(self.motor_torque).max(0), 3.0))

    @cached_property
    def inertia(self) -> Array:
        """Inertia of each joint for the controller [kg·m²], (n,)."""
        return controlled_inertia(self.model, self.command[:: len(self.command) // 16 + 1])

    @cached_property
    def link_inertia(self) -> Array:
        """Inertia of each joint in the middle of all ranges without its rotor [kg·m²], (n,)."""
        middle = 0.5 * (self.arm.lower + self.arm.upper)[None]
        return np.asarray(np.diag(mass_matrices(self.model, middle)[0]) - self.arm.armature)

    @cached_property
    def slope(self) -> Array:
        """∂τ_i/∂q_j along the motion (K', n, n) [N·m/rad]: gravity, Coriolis and inertia together."""
        q, v, a = self.motion
        out = np.empty((len(q), self.arm.n, self.arm.n))
        for j in range(self.arm.n):
            step = 1e-4 * (np.arange(self.arm.n) == j)
            out[:, :, j] = (inverse(self.model, q + step, v, a) - inverse(self.model, q - step, v, a)) / 2e-4
        return out

    def change(self, other: BenchArm) -> Array:
        """Change of the link-side torque with another arm in place of this one, (K', n)."""
        return inverse(compile_arm(other), *self.motion) - other.armature * self.motion[2] - self.torque

    def sensor_level(self, random: np.random.Generator) -> Array:
        """RMS that an effect should cause in `tau` − model, (n,) [N·m]."""
        return np.maximum(SENSOR_LEAST, random.uniform(*SHARES) * rms(self.torque))

    def motor_level(self, random: np.random.Generator) -> Array:
        """RMS that an effect should cause in `tau_motor` − model, (n,) [N·m]."""
        return np.maximum(MOTOR_LEAST, random.uniform(*SHARES) * rms(self.motor_torque))

    def turn_felt(self, error: Array) -> Array:
        """RMS torque at joint i (first axis) caused by an angle error (K', n) of joint j, (n, n) [N·m]."""
        return np.stack([rms(self.slope[:, :, j] * error[:, j, None]) for j in range(self.arm.n)], axis=1)

    def feed_forward(self, command: Array) -> Array:
        """Nominal torque along a trajectory at `motion.RATE`, rotors included (K, n)."""
        return inverse(self.model, command, *derivatives(command))


def rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(x), axis=0)))
