"""Momentum of an arm in motion, and how it changes, without any acceleration.

With p = M(q) q̇ the generalised momentum and T the kinetic energy, Lagrange's equation reads

    ṗ = ∂T/∂q − g(q) + τ,

τ being all torque that acts at the joints beside gravity's. p and ∂T/∂q need positions and velocities alone; so does an
observer of external torque that is built on them (De Luca and Mattone, ICRA 2005).

All vectors are in the base frame and all moments about its origin, so that velocities add up from the base outwards and
momenta from the tip inwards by cumulated sums. A joint's screw is s_i = (z_i, o_i × z_i); with the momentum h_i of all
links that it carries p_i = s_i · h_i, and since ∂T/∂q_i = ṡ_i · h_i with ṡ_i = v_i × s_i, one sweep gives both.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gcomp.arm.arm import Arm, bar_frames
from gcomp.arm.mass_moments import base_parameters
from gcomp.arrays import Array, Mask

INERTIAL = 10
"""Parameters of a link about its origin, in its bar frame: m, mx, my, mz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """An arm of n joints at K positions and velocities."""

    gravity: Array
    """(3,) [m/s²]."""
    rotation: Array
    """Axes of the bar frames (K, n, 3, 3)."""
    origin: Array
    """Origins of the bar frames (K, n, 3) [m]."""
    screw: Array
    """(K, n, 6): axis, and its moment about the base [m]."""
    rate: Array
    """Velocity of each link (K, n, 6): angular [rad/s], and of the point that is in the base's origin [m/s]."""
    screw_rate: Array
    """ṡ (K, n, 6)."""

    def part(self, rows: slice | Mask) -> "RigidMotion":
        found = (each[rows] for each in (self.rotation, self.origin, self.screw, self.rate, self.screw_rate))
        return RigidMotion(self.gravity, *found)

    @cached_property
    def origin_velocity(self) -> Array:
        """Of each link's origin (K, n, 3) [m/s]."""
        return self.rate[..., 3:] + _cross(self.rate[..., :3], self.origin)


def rigid_motion(arm: Arm, q: Array, velocity: Array) -> RigidMotion:
    """At positions (K, n) [rad] and velocities (K, n) [rad/s]."""
    rotation = bar_frames(arm, q).rotation
    steps = np.einsum("knij,nj->kni", rotation, arm.span)
    origin = np.zeros_like(steps)
    np.cumsum(steps[:, :-1], axis=1, out=origin[:, 1:])
    axis = rotation[..., 2]
    screw = np.concatenate([axis, _cross(origin, axis)], axis=-1)
    rate = np.cumsum(screw * velocity[..., None], axis=1)
    turning, moving = rate[..., :3], rate[..., 3:]
    screw_rate = np.concatenate(
        [_cross(turning, axis), _cross(turning, screw[..., 3:]) + _cross(moving, axis)], axis=-1
    )
    return RigidMotion(arm.gravity, rotation, origin, screw, rate, screw_rate)


def momentum_terms(motion: RigidMotion, inertial: Array) -> tuple[Array, Array]:
    """(p [N·m·s], ∂T/∂q − g [N·m]) (K, n) each, for links of inertial parameters (n, 10)."""
    turn, origin = motion.rotation, motion.origin
    mass = inertial[:, 0, None]
    moment = np.einsum("knij,nj->kni", turn, inertial[:, 1:4])
    omega, velocity = motion.rate[..., :3], motion.origin_velocity
    about = inertial[:, 4:][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    own = np.einsum("knji,knj->kni", turn, omega)
    spin = np.einsum("knij,knj->kni", turn, np.einsum("nij,knj->kni", about, own))
    linear = mass * velocity + _cross(omega, moment)
    angular = spin + _cross(moment, velocity) + _cross(origin, linear)
    weight = np.concatenate([_cross(mass * origin + moment, motion.gravity), mass * motion.gravity + 0 * origin], -1)
    carried = _inwards(np.concatenate([angular, linear], axis=-1))
    momentum = (motion.screw * carried).sum(-1)
    return momentum, (motion.screw_rate * carried).sum(-1) + (motion.screw * _inwards(weight)).sum(-1)


def momentum_regressors(motion: RigidMotion) -> tuple[Array, Array]:
    """Derivatives of `momentum_terms` by all inertial parameters, (K, n, 10 n) each."""
    count, n = motion.origin.shape[:2]
    turn, origin, omega, velocity = motion.rotation, motion.origin, motion.rate[..., :3], motion.origin_velocity
    momentum, weight = np.zeros((2, count, n, INERTIAL, 6))
    momentum[..., 0, 3:], weight[..., 0, 3:] = velocity, motion.gravity
    weight[..., 0, :3] = _cross(origin, motion.gravity)
    momentum[..., 0, :3] = _cross(origin, velocity)
    for k in range(3):
        along = turn[..., k]
        linear = _cross(omega, along)
        momentum[..., 1 + k, 3:] = linear
        momentum[..., 1 + k, :3] = _cross(origin, linear) + _cross(along, velocity)
        weight[..., 1 + k, :3] = _cross(along, motion.gravity)
    own = np.einsum("knji,knj->kni", turn, omega)
    for column, (i, j) in enumerate(PAIRS, start=4):
        spin = turn[..., i] * own[..., j, None]
        momentum[..., column, :3] = spin if i == j else spin + turn[..., j] * own[..., i, None]
    carries = np.tri(n).T[None, :, :, None]
    by_momentum = np.einsum("kic,kjpc->kijp", motion.screw, momentum, optimize=True) * carries
    by_rate = np.einsum("kic,kjpc->kijp", motion.screw_rate, momentum, optimize=True)
    by_rate = (by_rate + np.einsum("kic,kjpc->kijp", motion.screw, weight, optimize=True)) * carries
    return by_momentum.reshape(count, n, -1), by_rate.reshape(count, n, -1)


def jacobian(motion: RigidMotion, link: int, point: Array) -> Array:
    """(K, 6, n): force and moment at a point (3,) of a link's bar frame [m], base axes, to torques by its transpose."""
    at = motion.origin[:, link] + np.einsum("kij,j->ki", motion.rotation[:, link], point)
    axis = motion.screw[:, : link + 1, :3]
    out = np.zeros((len(at), 6, motion.screw.shape[1]))
    out[:, :3, : link + 1] = np.swapaxes(_cross(axis, at[:, None] - motion.origin[:, : link + 1]), 1, 2)
    out[:, 3:, : link + 1] = np.swapaxes(axis, 1, 2)
    return out


def gravity_split(arm: Arm) -> Array:
    """Columns (10 n, 10 n) of new parameters: first β (2n), then masses, mz and inertias (8 n) at the same β.

    The second kind shows in motion alone, and how well gravity is known says nothing of it.
    """
    n = arm.n
    to_beta = np.zeros((2 * n, INERTIAL * n))
    none, unit = np.zeros((n, 3)), np.zeros(n)
    for link in range(n):
        mass = unit.copy()
        mass[link] = 1.0
        to_beta[:, INERTIAL * link] = base_parameters(arm, mass, none)
        for axis in range(3):
            moment = none.copy()
            moment[link, axis] = 1.0
            to_beta[:, INERTIAL * link + 1 + axis] = base_parameters(arm, unit, moment)
    at = np.arange(n)[:, None] * INERTIAL
    crosswise = (at + np.array([1, 2])).ravel()
    others = (at + np.array([0, *range(3, INERTIAL)])).ravel()
    columns = np.zeros((INERTIAL * n, INERTIAL * n))
    columns[crosswise, np.arange(2 * n)] = 1.0
    columns[others, 2 * n + np.arange(8 * n)] = 1.0
    columns[crosswise, 2 * n :] -= to_beta[:, others]
    return columns


def _inwards(values: Array) -> Array:
    """Sums over each link and those that it carries, (K, n, …)."""
    return np.cumsum(values[:, ::-1], axis=1)[:, ::-1]


def _cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; numpy's own is several times slower on short arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
