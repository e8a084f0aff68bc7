"""Rigid-body torque of a chain of hinges and slides, and its exact regressor in every link's inertial parameters.

The Newton-Euler recursion runs over whole recordings at once, so that 10⁵ rows take less than a second. Whoever
makes one of a MuJoCo model checks it against `mj_inverse`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gcomp.arm.inertials import SIX, symmetric
from gcomp.arrays import Array, Mask

CREEP = 0.01
"""Speed [rad/s] below which the sign of a velocity is not defined and friction may take any value."""
INERTIAL = ("mass", "mx", "my", "mz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz")


Frame = tuple[Array, Array]
"""Rotation (3, 3, K) and origin [m] (3, K), or (3, 1) if it does not move, of a link in its parent's frame."""
LinkMotion = tuple[Sequence[Frame], list[tuple[Array, Array, Array]]]
"""Frame of each link; angular velocity, angular acceleration and acceleration of its origin less gravity, in its own
frame, (3, K) each."""
POSITION_STEP = 1e-5
"""Step of differences in a position [rad]: rounding and curvature then leave 1e-10 of the torque."""


@dataclass(frozen=True)
class Tendons:
    """The m fixed tendons of a model, restricted to the n joints of an arm."""

    turns: Array
    """Turn of each tendon per turn of each joint, (m, n)."""
    armature: Array
    damping: Array
    frictionloss: Array
    """(m,) each: kg·m², N·m·s/rad, N·m."""

    def torque(self, v: Array, a: Array) -> Array:
        """Motor torque that they take [N·m], (…, n); the sign of friction is linear within the creeping speed."""
        speed, push = v @ self.turns.T, a @ self.turns.T
        along = np.clip(speed / CREEP, -1.0, 1.0)
        return np.asarray((self.armature * push + self.damping * speed + self.frictionloss * along) @ self.turns)


@dataclass(frozen=True)
class RigidArm:
    """An arm of n hinges and slides: geometry, nominal inertial parameters, and the model's own joint terms.

    The position of a slide is in m and its torque a force in N, and so on in all units of joints.
    """

    names: tuple[str, ...]
    parent: tuple[int, ...]
    """Index of the link before each link; -1 for the base."""
    rotation: Array
    """Link frame at joint angle zero in the parent link's frame, (n, 3, 3)."""
    offset: Array
    """Origin of the link frame (on the joint axis) in the parent link's frame [m], (n, 3)."""
    axis: Array
    """Joint axis in the link frame, (n, 3)."""
    slides: Mask
    """Joints that slide along their axis instead of turning about it, (n,)."""
    zero: Array
    """Joint position at angle zero (MuJoCo's qpos0) [rad], (n,)."""
    range: Array
    """Lowest and highest position of each joint [rad], (n, 2); infinite without limits."""
    inertial: Array
    """Mass [kg], first moment [kg·m], inertia about the origin [kg·m²] in the link frame, (n, 10) as in INERTIAL."""
    gravity: Array
    """[m/s²] in the base frame, (3,)."""
    armature: Array
    damping: Array
    frictionloss: Array
    """Motor-side terms of the nominal joints, (n,) each: kg·m², N·m·s/rad, N·m."""
    creep: Array
    """Speed up to which MuJoCo lets the nominal joints creep under less than that friction [rad/s], (n,)."""
    stiffness: Array
    rest: Array
    """Springs of the nominal joints, beside the motor and on the link side, (n,) each: N·m/rad, rad."""
    tendons: Tendons
    """Motors coupled to several joints."""

    @property
    def n(self) -> int:
        return len(self.names)

    def unit_at(self, joint: int, unit: str) -> str:
        """A unit of a hinge as this joint has it: of a slide N for N·m, m for rad, and kg for kg·m²."""
        if not self.slides[joint] or "(N·m)" in unit:
            return unit
        return unit.replace("N·m", "N").replace("kg·m²", "kg").replace("rad", "m")

    @cached_property
    def carries(self) -> Mask:
        """(n, n): whether joint i carries link j."""
        carries = np.eye(self.n, dtype=bool)
        for link in range(self.n):
            if self.parent[link] >= 0:
                carries[:, link] |= carries[:, self.parent[link]]
        return carries

    @property
    def stretched_torque(self) -> float:
        """Torque that the links' weight would have at the base, all stretched out and lying [N·m]."""
        moments = self.inertial[:, 0] * self._reach + np.linalg.norm(self.inertial[:, 1:4], axis=1)
        return float(np.linalg.norm(self.gravity) * moments.sum())

    @property
    def stretched_inertia(self) -> float:
        """Inertia of the links about the base, all stretched out [kg·m²]."""
        mass = np.maximum(self.inertial[:, 0], 1e-9)
        return float(mass @ (self._reach + np.linalg.norm(self.inertial[:, 1:4], axis=1) / mass) ** 2)

    @property
    def _reach(self) -> Array:
        """Distance of each joint from the base with all links stretched out [m], (n,)."""
        reach = np.zeros(self.n)
        for j, before in enumerate(self.parent):
            if before >= 0:
                reach[j] = reach[before] + np.linalg.norm(self.offset[j])
        return reach

    def torque(
        self, q: Array, v: Array, a: Array, gravity: Array | None = None, *, frames: Sequence[Frame] | None = None
    ) -> Array:
        """Link-side torque τ = M(q) a + C(q, v) v + ∂V/∂q of the rigid links [N·m], (K, n).

        q, v, a (K, n) in rad, rad/s, rad/s²; gravity (3,) in the base frame, by default the model's; `frames` as in
        `motion`.
        """
        frames, moves = self.motion(q, v, a, gravity, frames=frames)
        forces, couples = [], []
        for j, (omega, alpha, push) in enumerate(moves):
            mass, moment, inertia = self.inertial[j, 0], self.inertial[j, 1:4], symmetric(self.inertial[j, 4:])
            forces.append(mass * push + cross(alpha, moment) + cross(omega, cross(omega, moment)))
            couples.append(inertia @ alpha + cross(omega, inertia @ omega) - cross(push, moment))
        for j in reversed(range(self.n)):
            up, (turn, origin) = self.parent[j], frames[j]
            if up >= 0:
                force = out_of_frame(turn, forces[j])
                forces[up] = forces[up] + force
                couples[up] = couples[up] + out_of_frame(turn, couples[j]) - cross(force, origin)
        loads = [forces[j] if slides else couples[j] for j, slides in enumerate(self.slides)]
        return np.stack([axis @ load for axis, load in zip(self.axis, loads, strict=True)], axis=1)

    def gravity_torque(self, q: Array, gravity: Array | None = None) -> Array:
        """`torque` at rest."""
        return self.torque(q, np.zeros_like(q), np.zeros_like(q), gravity)

    def link_regressor(self, motion: LinkMotion, link: int) -> Array:
        """Columns of `torque` in the ten inertial parameters of one link, (K, n, 10); zero where it is not carried."""
        frames, moves = motion
        rows = moves[link][0].shape[1]
        out = np.zeros((self.n, 10, rows))
        down = np.eye(3)[:, :, None]  # from the frame of a joint to the link's
        lever: Array = np.zeros((3, 1))
        i = link
        while i >= 0:
            axis = np.broadcast_to(np.einsum("ijk,j->ik", down, self.axis[i]), (3, rows))
            if self.slides[i]:
                out[i] = _link_columns(np.zeros_like(axis), axis, *moves[link])
            else:
                out[i] = _link_columns(axis, cross(axis, np.broadcast_to(lever, (3, rows))), *moves[link])
            turn, origin = frames[i]
            down = np.einsum("ijk,ljk->ilk", down, turn)
            lever = lever + np.einsum("ijk,jk->ik", down, origin)
            i = self.parent[i]
        return np.moveaxis(out, -1, 0)

    def frame(self, joint: int, q: Array) -> Frame:
        """Frame of a link at its joint's positions (K,) [rad]."""
        rotation, axis, away = self.rotation[joint], self.axis[joint], q - self.zero[joint]
        if self.slides[joint]:
            turn = np.broadcast_to(rotation[..., None], (3, 3, len(q)))
            return turn, self.offset[joint][:, None] + np.outer(rotation @ axis, away)
        return turned(rotation, axis, away), self.offset[joint][:, None]

    def motion(
        self, q: Array, v: Array, a: Array, gravity: Array | None = None, *, frames: Sequence[Frame] | None = None
    ) -> LinkMotion:
        """How the links move, from base to tip; `frames` are theirs at q, where they are known."""
        field = self.gravity if gravity is None else gravity
        still = np.zeros((3, len(q)))
        base = still, still, still - np.asarray(field, float)[:, None]
        frames = frames or [self.frame(j, q[:, j]) for j in range(self.n)]
        moves: list[tuple[Array, Array, Array]] = []
        for j, (turn, lever) in enumerate(frames):
            omega, alpha, push = moves[self.parent[j]] if self.parent[j] >= 0 else base
            if self.parent[j] >= 0:
                push = push + cross(alpha, lever) + cross(omega, cross(omega, lever))
            omega, alpha, push = into_frame(turn, omega), into_frame(turn, alpha), into_frame(turn, push)
            speed, gain = self.axis[j][:, None] * v[:, j], self.axis[j][:, None] * a[:, j]
            if self.slides[j]:
                moves.append((omega, alpha, push + gain + 2.0 * cross(omega, speed)))
            else:
                moves.append((omega + speed, alpha + gain + cross(omega, speed), push))
        return frames, moves

    def carried(self, q: Array, v: Array, a: Array) -> Array:
        """Torque that the links take of a motor: `torque` and that of the springs across the joints [N·m], (K, n)."""
        return self.torque(q, v, a) + self.spring_torque(q)

    def spring_torque(self, q: Array) -> Array:
        return np.asarray(self.stiffness * (q - self.rest))

    def nominal_joint_torque(self, v: Array, a: Array, direction: Array) -> Array:
        """Torque of the nominal joints on the motor side: armature, damping, friction loss, tendons (K, n).

        `direction` is the sign of the velocity, smoothed around rest by the caller.
        """
        own = self.armature * a + self.damping * v + self.frictionloss * direction
        return np.asarray(own + self.tendons.torque(v, a))


def _link_columns(axis: Array, lever: Array, omega: Array, alpha: Array, push: Array) -> Array:
    """Ten columns of one link for one joint: axis·(torque) + lever·(force), all in the link's frame, (10, K)."""
    out = np.empty((10, axis.shape[1]))
    out[0] = (lever * push).sum(0)
    out[1:4] = cross(lever, alpha) + cross(cross(lever, omega), omega) + cross(push, axis)
    gyro = cross(axis, omega)
    for column, (r, c) in enumerate(zip(*SIX, strict=True), start=4):
        value = axis[r] * alpha[c] + gyro[r] * omega[c]
        out[column] = value if r == c else value + axis[c] * alpha[r] + gyro[c] * omega[r]
    return out


def cross(x: Array, y: Array) -> Array:
    """Cross product of vectors (3, K) with vectors (3, K) or one vector (3,) or (3, 1)."""
    out = np.empty_like(x)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(x[i], y[j], out=out[k])
        out[k] -= x[j] * y[i]
    return out


def into_frame(turn: Array, vector: Array) -> Array:
    """Into the rotated frame: Rᵀ x for rotations (3, 3, K) and vectors (3, K)."""
    return np.asarray(np.einsum("jik,jk->ik", turn, vector))


def out_of_frame(turn: Array, vector: Array) -> Array:
    """Out of the rotated frame: R x."""
    return np.asarray(np.einsum("ijk,jk->ik", turn, vector))


def turned(start: Array, axis: Array, angle: Array | float) -> Array:
    """Rotation `start` (3, 3) followed by angles (K,) about one axis (3,), by Rodrigues' formula, (3, 3, K); by one
    angle, (3, 3)."""
    x, y, z = axis
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    parts = start, start @ hat, start @ hat @ hat
    if np.ndim(angle) == 0:
        return np.asarray(parts[0] + parts[1] * sine + parts[2] * versine)
    return np.asarray(parts[0][..., None] + parts[1][..., None] * sine + parts[2][..., None] * versine)


def torque_slopes(
    arm: RigidArm, frames: Sequence[Frame], q: Array, v: Array, a: Array, joint: int
) -> tuple[Array, Array, Array]:
    """∂τ/∂q, ∂τ/∂v and ∂τ/∂a of one joint, (K, n) each; `frames` are those of the links at q.

    By central differences in q and v, which are exact in v: the torque is quadratic in it. ∂τ/∂a is a column of M(q).
    """
    unit = np.eye(arm.n)[joint]

    def changed(way: float, speed: float) -> Array:
        own = frames
        if way:
            own = [*frames[:joint], arm.frame(joint, q[:, joint] + way), *frames[joint + 1 :]]
        return arm.torque(q, v + speed * unit, a, frames=own)

    by_position = (changed(POSITION_STEP, 0.0) - changed(-POSITION_STEP, 0.0)) / (2.0 * POSITION_STEP)
    by_velocity = (changed(0.0, 1.0) - changed(0.0, -1.0)) / 2.0
    still = np.zeros_like(v)
    return by_position, by_velocity, arm.torque(q, still, still + unit, np.zeros(3), frames=frames)
