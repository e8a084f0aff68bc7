"""Motors, friction, gears and position sensors of many arms: from commanded torque to the forces on the links.

Friction is elasto-plastic (Dupont, Hayward, Armstrong, Altpeter 2002): LuGre friction without drift at rest.

f = σ₀ z + σ₁ ż + d v,  ż = v (1 − α(z, v) z/z_ss),  z_ss = g(v, τ)/σ₀ in the direction of v; α is 0 in the elastic
range (|z| below 0.7 z_ss, or v and z of opposite sign), rises smoothly and is 1 in sliding.
g = (coulomb + breakaway·exp(−(v/v_s)²) + load·|τ|)·(1 ± asymmetry).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array, Mask
from sim_gap.blind.true_arm import TrueArm

ELASTIC_SHARE = 0.7
"""Deflection of the bristles, as a share of z_ss, up to which α is 0."""
SPRING_DAMPING_RATIO = 0.04
"""Damping ratio of an elastic transmission."""
STIFFEST = 0.05
"""σ₀ h²/(inertia) is at most this, for a stable step."""


class Bristles:
    """Friction of many arms at once, (B, width); columns beyond an arm's joints are frictionless."""

    def __init__(self, truths: Sequence[TrueArm], inertia: Array, step: float) -> None:
        """`inertia` (B, width): least inertia that each motor moves [kg·m²]; `step` [s]."""
        width = inertia.shape[1]
        self.coulomb, self.viscous, self.breakaway, self.load = (
            pad_rows([getattr(t, name) for t in truths], width)
            for name in ("coulomb", "viscous", "breakaway", "load_friction")
        )
        self.fade = 1.0 / pad_rows([t.stribeck_velocity for t in truths], width, 1.0) ** 2
        self.asymmetry = pad_rows([t.asymmetry for t in truths], width)
        self.rows = np.array([t.breakaway.any() or t.asymmetry.any() or t.load_friction.any() for t in truths])
        largest = np.maximum(self.coulomb + self.breakaway, 0.05)
        self.bristle = np.minimum(largest / 2e-4, STIFFEST * inertia / step**2)
        self.bristle_damping = 0.3 * np.sqrt(self.bristle * inertia)
        self.step = step
        self.bend = np.zeros_like(inertia)

    def force(self, v: Array, load: Array) -> Array:
        """Friction torque against motor velocities `v` [rad/s] of the first len(v) arms, `load` the torque carried."""
        k = len(v)
        level = self.coulomb[:k]
        if self.rows[:k].any():
            level = level + self.breakaway[:k] * np.exp(-(v**2) * self.fade[:k]) + self.load[:k] * np.abs(load)
            level *= 1.0 + self.asymmetry[:k] * np.sign(v)
        longest = level / self.bristle[:k] + 1e-12
        z = self.bend[:k]
        ratio = z * np.sign(v) / longest
        slip = np.clip((ratio - ELASTIC_SHARE) / (1.0 - ELASTIC_SHARE), 0.0, 1.0)
        slip *= slip * (3.0 - 2.0 * slip)
        rate = v * (1.0 - slip * np.abs(ratio))
        z += self.step * rate
        np.clip(z, -longest, longest, out=z)
        return np.asarray(self.bristle[:k] * z + self.bristle_damping[:k] * rate + self.viscous[:k] * v)


def pad_rows(rows: Sequence[Array], width: int, fill: float = 0.0) -> Array:
    """Rows of different lengths as one array (B, width)."""
    out = np.full((len(rows), width), fill)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = values
    return out


class PlantDrives:
    """State of all drives, (B, width); methods act on the first k arms, k being the length of their arguments."""

    def __init__(
        self, truths: Sequence[TrueArm], inertia: Array, angle: Array, torque: Sequence[Array], step: float
    ) -> None:
        """`inertia` (B, width): least inertia that each motor moves [kg·m²]; `angle`, `torque` at rest; `step` [s]."""
        width = angle.shape[1]
        self.step, self.count = step, 0
        self.current = pad_rows(torque, width)
        lag = pad_rows([t.motor_lag for t in truths], width, step)
        self.follow = 1.0 - np.exp(-step / np.maximum(lag, 0.1 * step))
        self.limit = pad_rows([t.motor_limit for t in truths], width, np.inf)
        self.gain = pad_rows([t.motor_gain for t in truths], width, 1.0)
        delay = np.rint(pad_rows([t.motor_delay for t in truths], width) / step).astype(int)
        self.late = _Cells(delay > 0)
        self.wait = delay[self.late.all]
        self.queue = np.repeat(self.current[None], int(delay.max()) + 1, axis=0)
        self.bristles = Bristles(truths, inertia, step)
        self.ripple = [pad_rows([t.ripple[:, c] for t in truths], width) for c in range(3)]
        self.spring, self.rest = (pad_rows([t.spring[:, c] for t in truths], width) for c in range(2))
        self.shared = [(b, s) for b, t in enumerate(truths) for s in t.shared]
        self.armature = pad_rows([np.where(t.elastic, 0.0, t.arm.armature) for t in truths], width)
        self.passed = self.current.copy()
        self.carried = self.current.copy()
        self._sense(truths, width)
        self._two_masses(truths, angle)

    def _sense(self, truths: Sequence[TrueArm], width: int) -> None:
        self.position_gain = pad_rows([t.position_gain for t in truths], width, 1.0)
        self.position_offset = pad_rows([t.position_offset for t in truths], width)
        self.bent = _Cells(pad_rows([t.eccentricity[:, 0] for t in truths], width) != 0.0)
        self.amplitude, self.phase = (
            pad_rows([t.eccentricity[:, c] for t in truths], width)[self.bent.all] for c in range(2)
        )

    def _two_masses(self, truths: Sequence[TrueArm], angle: Array) -> None:
        self.soft = _Cells(np.isfinite(pad_rows([t.stiffness for t in truths], angle.shape[1], np.inf)))
        rows = list(zip(*(cells.tolist() for cells in self.soft.all), strict=True))
        self.stiffness = np.array([truths[b].stiffness[j] for b, j in rows])
        self.half_play = np.array([0.5 * truths[b].backlash[j] for b, j in rows])
        self.rotor = np.array([truths[b].arm.armature[j] for b, j in rows])
        self.spring_damping = 2.0 * SPRING_DAMPING_RATIO * np.sqrt(self.stiffness * self.rotor)
        torque = self.current[self.soft.all]
        self.motor_angle = angle[self.soft.all] + torque / self.stiffness + self.half_play * np.sign(torque)
        self.motor_half, self.motor_speed, self.motor_push = (np.zeros(len(rows)) for _ in range(3))

    def reading(self, angle: Array) -> Array:
        """Exact reading φ of the position sensors, which are at the motor.

        θ = gain·φ + offset + amplitude·sin(φ + phase).
        """
        k = len(angle)
        turned = angle.copy()
        soft, few = self.soft.within(k)
        turned[soft] = self.motor_angle[:few]
        reading = (turned - self.position_offset[:k]) / self.position_gain[:k]
        bent, few = self.bent.within(k)
        if few:
            straight, gain = reading[bent], self.position_gain[bent]
            phi = straight
            for _ in range(6):  # contracts by amplitude each time
                phi = straight - self.amplitude[:few] / gain * np.sin(phi + self.phase[:few])
            reading[bent] = phi
        return np.asarray(reading)

    def forces(self, angle: Array, velocity: Array, command: Array) -> Array:
        """Generalized forces on the links [N·m] for the controller's torque `command` [N·m]."""
        k = len(angle)
        self._follow(command)
        speed, turned = velocity, angle
        soft, few = self.soft.within(k)
        if few or self.shared:
            speed, turned = velocity.copy(), angle.copy()
        if few:
            speed[soft], turned[soft] = self.motor_speed[:few], self.motor_angle[:few]
        shared = [(b, s) for b, s in self.shared if b < k] if self.shared else ()
        for b, s in shared:
            speed[b, s.joint] += s.coefficient * velocity[b, s.other]
        amplitude, cycles, phase = (part[:k] for part in self.ripple)
        lost = self.bristles.force(speed, self.carried[:k]) + amplitude * np.sin(cycles * turned + phase)
        passed = self.passed[:k]
        np.subtract(self.gain[:k] * self.current[:k], lost, out=passed)
        for b, s in shared:
            passed[b, s.other] -= s.coefficient * lost[b, s.joint]
        if few:
            through = self._gear(few, angle[soft], velocity[soft])
            self.motor_push[:few] = (passed[soft] - through) / self.rotor[:few]
            passed[soft] = through
        return np.asarray(passed - self.spring[:k] * (angle - self.rest[:k]))

    def move(self, k: int) -> None:
        """One leapfrog step of the motors behind springs."""
        self.count += 1
        _, few = self.soft.within(k)
        if few:
            push = self.motor_push[:few]
            self.motor_half[:few] += self.step * push
            self.motor_angle[:few] += self.step * self.motor_half[:few]
            self.motor_speed[:few] = self.motor_half[:few] + 0.5 * self.step * push

    def link_torque(self, acceleration: Array) -> Array:
        """Torque at the link side of each transmission [N·m]: transmitted torque less that of the rotors."""
        k = len(acceleration)
        torque = self.passed[:k] - self.armature[:k] * acceleration
        for b, s in self.shared:
            if b < k:
                rotor = s.inertia * (acceleration[b, s.joint] + s.coefficient * acceleration[b, s.other])
                torque[b, s.joint] -= rotor
                torque[b, s.other] -= s.coefficient * rotor
        self.carried[:k] = torque
        return np.asarray(torque)

    def _follow(self, command: Array) -> None:
        """The current loops: delay, lag, limit."""
        k, size = len(command), len(self.queue)
        self.queue[self.count % size, :k] = command
        late, few = self.late.within(k)
        if few:
            command = command.copy()
            command[late] = self.queue[(self.count - self.wait[:few]) % size, late[0], late[1]]
        current = self.current[:k]
        current += self.follow[:k] * (command - current)
        np.clip(current, -self.limit[:k], self.limit[:k], out=current)

    def _gear(self, few: int, angle: Array, velocity: Array) -> Array:
        """Torque through springs with backlash: zero within the play, never pulling on the contact."""
        twist = self.motor_angle[:few] - angle
        stretch = twist - np.clip(twist, -self.half_play[:few], self.half_play[:few])
        torque = self.stiffness[:few] * stretch + self.spring_damping[:few] * (self.motor_speed[:few] - velocity)
        free = (self.half_play[:few] > 0) & (torque * stretch <= 0)
        return np.asarray(np.where(free, 0.0, torque))


class _Cells:
    """Cells (arm, joint) of a mask in row order; `within(k)` gives those of the first k arms and their number."""

    def __init__(self, mask: Mask) -> None:
        self.rows, self.columns = np.nonzero(mask)
        self.all = (self.rows, self.columns)
        self._k, self._found = -1, (self.all, len(self.rows))

    def within(self, k: int) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], int]:
        if k != self._k:
            few = int(np.searchsorted(self.rows, k))
            self._k, self._found = k, ((self.rows[:few], self.columns[:few]), few)
        return self._found
