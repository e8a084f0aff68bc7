"""Momentum of an arm in motion, and how it changes, without any acceleration.

With p = M(q) q̇ the generalised momentum and T the kinetic energy, Lagrange's equation reads

    ṗ = ∂T/∂q − g(q) + τ,

τ being all torque that acts at the joints beside gravity's. p and ∂T/∂q need positions and velocities alone; so does an
observer of external torque that is built on them (De Luca and Mattone, ICRA 2005).

Velocities are in the base frame and all moments about its origin, so that they add up from the base outwards and
momenta from the tip inwards by cumulated sums. A joint's screw is s_i = (z_i, o_i × z_i); with the momentum h_i of all
links that it carries p_i = s_i · h_i, and since ∂T/∂q_i = ṡ_i · h_i with ṡ_i = v_i × s_i, one sweep gives both. A
link's own momentum is its inertia in its bar frame, a constant, times its velocity there; its weight is the same
inertia times the acceleration of gravity.
"""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm, bar_rotations
from gcomp.arm.inertials import SIX
from gcomp.arm.mass_moments import link_columns
from gcomp.arrays import Array, Mask, cross

LINK_PARAMETERS = 10
"""Parameters of a link about its origin, in its bar frame: m, mx, my, mz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""


def _by_parameter() -> Array:
    """Inertia (10, 6, 6) of each parameter alone: velocity (angular, linear) to momentum (angular, linear)."""
    out = np.zeros((LINK_PARAMETERS, 6, 6))
    out[0, 3:, 3:] = np.eye(3)
    for k, unit in enumerate(np.eye(3), start=1):
        out[k, :3, 3:] = np.cross(unit, np.eye(3)).T
        out[k, 3:, :3] = -out[k, :3, 3:]
    for k, (i, j) in enumerate(zip(*SIX, strict=True), start=4):
        out[k, i, j] = out[k, j, i] = 1.0
    return out


BY_PARAMETER = _by_parameter()
BY_VELOCITY = BY_PARAMETER.transpose(2, 1, 0).reshape(6, 6 * LINK_PARAMETERS)
"""The same from velocities (6) to the derivatives of the momentum by the parameters (6, 10)."""


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """An arm of n joints at K positions and velocities."""

    to_link: Array
    """Velocities (angular, linear at the base's origin) in the base frame to those of each link's origin in its bar
    frame (K, n, 6, 6); its transpose brings forces back."""
    origin: Array
    """Origins of the bar frames (K, n, 3) [m]."""
    moves: Array
    """Of each link, in its bar frame: velocity, and gravity as an acceleration (K, n, 6, 2) [rad/s, m/s; m/s²]."""
    screw: Array
    """(K, n, 6): axis, and its moment about the base [m]."""
    screw_rate: Array
    """ṡ (K, n, 6)."""

    @property
    def rotation(self) -> Array:
        """Axes of the bar frames (K, n, 3, 3)."""
        return self.to_link[..., :3, :3].swapaxes(-1, -2)

    def part(self, rows: slice | Mask) -> "RigidMotion":
        return RigidMotion(
            self.to_link[rows], self.origin[rows], self.moves[rows], self.screw[rows], self.screw_rate[rows]
        )


def rigid_motion(arm: Arm, q: Array, velocity: Array) -> RigidMotion:
    """At positions (K, n) [rad] and velocities (K, n) [rad/s]."""
    count, n = q.shape
    turn = bar_rotations(arm, q)
    origin = np.zeros((count, n, 3))
    np.cumsum((turn @ arm.span[:, :, None])[:, :-1, :, 0], axis=1, out=origin[:, 1:])
    to_link = np.zeros((count, n, 6, 6))
    to_link[..., :3, :3] = to_link[..., 3:, 3:] = along = turn.swapaxes(-1, -2)
    to_link[..., 3:, :3] = cross(origin[:, :, None], along)
    x, y, screw = (to_link[..., k::3, :3].reshape(count, n, 6) for k in range(3))
    moves = np.empty((count, n, 6, 2))
    np.cumsum(screw * velocity[..., None], axis=1, out=moves[..., 0])
    moves[..., :3, 1], moves[..., 3:, 1] = 0.0, arm.gravity
    moves = to_link @ moves
    screw_rate = moves[..., 1, :1] * x - moves[..., 0, :1] * y
    screw_rate[..., 3:] += moves[..., 4, :1] * x[..., :3] - moves[..., 3, :1] * y[..., :3]
    return RigidMotion(to_link, origin, moves, screw, screw_rate)


def momentum_terms(motion: RigidMotion, inertial: Array) -> tuple[Array, Array, Array]:
    """(p [N·m·s], ∂T/∂q − g [N·m], g [N·m]) (K, n) each, for links of inertial parameters (n, 10)."""
    inertia = (inertial @ BY_PARAMETER.reshape(LINK_PARAMETERS, 36)).reshape(-1, 6, 6)
    carried = _inwards(motion.to_link.swapaxes(-1, -2) @ (inertia @ motion.moves))
    by_screw = (motion.screw[..., None, :] @ carried)[..., 0, :]
    gravity = -by_screw[..., 1]
    return by_screw[..., 0], (motion.screw_rate * carried[..., 0]).sum(-1) - gravity, gravity


def momentum_regressors(motion: RigidMotion) -> tuple[Array, Array]:
    """Derivatives of the first two of `momentum_terms` by all inertial parameters, (K, n, 10 n) each."""
    count, n = motion.origin.shape[:2]
    own = motion.moves.swapaxes(-1, -2) @ BY_VELOCITY
    own = (
        own.reshape(count, n, 2, 6, LINK_PARAMETERS).transpose(0, 1, 3, 2, 4).reshape(count, n, 6, 2 * LINK_PARAMETERS)
    )
    base = (motion.to_link.swapaxes(-1, -2) @ own).reshape(count, n, 6, 2, LINK_PARAMETERS)
    momentum, weight = base.transpose(3, 0, 2, 1, 4).reshape(2, count, 6, n * LINK_PARAMETERS)
    carries = np.arange(n)[:, None] <= np.arange(n * LINK_PARAMETERS) // LINK_PARAMETERS
    by_momentum = (motion.screw @ momentum) * carries
    return by_momentum, (motion.screw_rate @ momentum + motion.screw @ weight) * carries


def jacobian(motion: RigidMotion, link: int, point: Array) -> Array:
    """(K, 6, n): force and moment at a point (3,) of a link's bar frame [m], base axes, to torques by its transpose."""
    at = motion.origin[:, link] + motion.rotation[:, link] @ point
    screw = motion.screw[:, : link + 1]
    out = np.zeros((len(at), 6, motion.screw.shape[1]))
    out[:, :3, : link + 1] = (cross(screw[..., :3], at[:, None]) + screw[..., 3:]).swapaxes(1, 2)
    out[:, 3:, : link + 1] = screw[..., :3].swapaxes(1, 2)
    return out


def gravity_split(arm: Arm) -> Array:
    """Columns (10 n, 10 n) of new parameters: first β (2n), then masses, mz and inertias (8 n) at the same β.

    The second kind shows in motion alone, and how well gravity is known says nothing of it.
    """
    n = arm.n
    to_beta = np.zeros((2 * n, n, LINK_PARAMETERS))
    for link in range(n):
        to_beta[:, link, 0], to_beta[:, link, 1:4] = link_columns(arm, link)
    at = np.arange(n)[:, None] * LINK_PARAMETERS
    crosswise = (at + np.array([1, 2])).ravel()
    others = (at + np.array([0, *range(3, LINK_PARAMETERS)])).ravel()
    columns = np.zeros((LINK_PARAMETERS * n, LINK_PARAMETERS * n))
    columns[crosswise, np.arange(2 * n)] = 1.0
    columns[others, 2 * n + np.arange(8 * n)] = 1.0
    columns[crosswise, 2 * n :] -= to_beta.reshape(2 * n, -1)[:, others]
    return columns


def _inwards(values: Array) -> Array:
    """Sums over each link and those that it carries, (K, n, …)."""
    return np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
