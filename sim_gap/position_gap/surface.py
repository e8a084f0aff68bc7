"""A surface that the arm presses on: joints that stop short of their commands the more, the lower the arm goes.

A table under the arm carries part of the command's torque: τ_j = −(∂z/∂q_j) f, with z the height of the point that
touches and f the force. No property of the arm does that below one height, at several joints at once, each in
proportion to its lever ∂z/∂q_j. The point and the height are not known, and a model often has no shapes; both are found
from the errors e = q_cmd − q, beside what controllers, friction and gravity do to them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import least_squares

from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.model.rigid_body import RigidArm, into_frame
from sim_gap.position_gap.tracks import in_one_order, period_of

SAMPLING_HZ = 10.0
"""Rate at which recordings are looked at [Hz]."""
REST = 0.03
"""Speed [rad/s] at which friction has turned over for the most part."""
JOINTS = 2
"""Least number of joints that must show a surface: at one alone, a stop looks the same."""
SURE, ALSO = (0.6, 2.0), (0.35, 1.5)
"""Signs of it at one joint, and at the others: the share of the squared error below it that a surface takes, and the
error that it makes over the usual one."""
MOST = 0.3
"""Largest share of the samples that touch: what happens more often is a property of the arm."""
FEWEST = 20
"""Least number of samples that touch: two seconds. With half as many, one of sixty arms without has a surface."""
ROWS = 200
"""Least number of samples that are looked at."""
HEIGHT_SHARES = (0.01, 0.03, 0.1, 0.2)
"""Shares of the samples that are below the heights from which the search starts."""
NEAR, FIRMLY = 0.12, 0.1
"""Standard deviation of the touching point about the link's centre of mass, as a share of the arm's length, and the
weight of that beside one sample's error."""
SHORTEST_ARM_M = 0.01
"""Length that an arm is taken to have at least [m]: models of bare motors have none."""
PRESSED = 0.95
"""Share of the samples that are commanded well below the surface whose heights are those of the touch."""
HEIGHT_TOLERANCE_M = 1e-6
"""Heights that differ by less are one height [m]: an arm that rests has one position."""
RELEASE_S = 0.3
"""Time after a touch, and half as long before it, that is left out, too: the servo has to recover [s]."""


@dataclass(frozen=True)
class Surface:
    """A horizontal surface that a point of one link presses on."""

    link: int
    """Index of the link in the arm."""
    point: Array
    """The point in the frame of the link [m], (3,)."""
    height: float
    """Height above the base's origin, against gravity, up to which the point is when it is pressed down [m]."""
    joints: tuple[int, ...]
    """Joints whose errors show it."""

    def touched(self, arm: RigidArm, t: Array, q: Array) -> Mask:
        """Times of a recording at which the arm touches or has just been released, (K,); q (K, n) [rad]."""
        origin, up = heights(arm, q, self.link)
        below = (origin + self.point @ up < self.height + HEIGHT_TOLERANCE_M).astype(np.uint8)
        rows = max(1, round(RELEASE_S / float(np.median(np.diff(t)))))
        before = maximum_filter1d(below, 2 * (rows // 2) + 1)
        after = maximum_filter1d(below, rows + 1, origin=rows // 2)
        return np.asarray((before | after).astype(bool))


def heights(arm: RigidArm, q: Array, link: int) -> tuple[Array, Array]:
    """Height of a link's origin above that of the base (K,) [m]; the upward direction in the link's frame (3, K)."""
    turns, _ = arm.motion(q, np.zeros_like(q), np.zeros_like(q))
    chain = np.flatnonzero(arm.carries[:, link])
    up = np.broadcast_to(-(arm.gravity / np.linalg.norm(arm.gravity))[:, None], (3, len(q)))
    height: Array = np.zeros(len(q))
    for j in chain:
        height = height + arm.offset[j] @ up
        up = into_frame(turns[j], up)
    return height, up


def rows_of_touch(surface: Surface | None, arm: RigidArm, recording: Recording) -> Mask:
    """Rows of a recording at which the arm touches, (K,); none without a surface."""
    if surface is None:
        return np.zeros(len(recording.t), bool)
    return surface.touched(arm, recording.t, recording.position)


def find_surface(arm: RigidArm, recordings: Sequence[Recording]) -> Surface | None:
    """The surface that the arm presses on in some of the recordings of commanded and measured positions, if any."""
    if arm.n < JOINTS or np.linalg.norm(arm.gravity) < 1e-6:
        return None
    looked = _Looked.of(arm, recordings)
    if len(looked.q) < ROWS:
        return None
    found = [_Under(looked, link).surface() for link in range(arm.n) if arm.carries[:, link].sum() >= JOINTS]
    return max((each for each in found if each is not None), key=lambda each: each[0], default=(0.0, None))[1]


@dataclass(frozen=True, eq=False)
class _Looked:
    """Positions, commands, and what is unusual of the errors between, at a low rate, (K, n) each."""

    arm: RigidArm
    q: Array
    command: Array
    besides: list[Array]
    """Error of each joint by controller, friction and gravity: an orthonormal basis, (K, m) each."""
    error: Array
    """Error that they leave over its RMS, (K, n)."""

    @classmethod
    def of(cls, arm: RigidArm, recordings: Sequence[Recording]) -> "_Looked":
        parts: list[tuple[Array, ...]] = []
        for recording in (recordings[number] for number in in_one_order(recordings)):
            assert recording.position_command is not None
            there = np.isfinite(recording.position_command).all(1) & np.isfinite(recording.position).all(1)
            stride = max(1, round(1.0 / SAMPLING_HZ / period_of(recording)))
            rows = np.flatnonzero(there)[::stride]
            if len(rows) < 3:
                continue
            speed = np.gradient(recording.position[rows], recording.t[rows], axis=0)
            direction = np.column_stack([_direction(speed[:, j]) for j in range(arm.n)])
            parts.append((recording.position[rows], recording.position_command[rows], speed, direction))
        if not parts:
            nothing = np.empty((0, arm.n))
            return cls(arm, nothing, nothing, [], nothing)
        q, command, v, direction = (np.vstack(part) for part in zip(*parts, strict=True))
        gravity = arm.torque(q, np.zeros_like(q), np.zeros_like(q))
        besides = []
        for j in range(arm.n):
            own = np.column_stack([np.ones(len(q)), direction[:, j], np.tanh(v[:, j] / REST), v[:, j], gravity[:, j]])
            basis, size, _ = np.linalg.svd(own, full_matrices=False)
            besides.append(basis[:, size > 1e-9 * size[0]])
        left = np.column_stack([e - b @ (b.T @ e) for e, b in zip((command - q).T, besides, strict=True)])
        usual = np.sqrt(np.mean(left**2, axis=0)) + 1e-6
        return cls(arm, q, command, besides, left / usual)


class _Under:
    """Errors that a surface under one link makes; x = (point in the link's frame, height), (4,) [m]."""

    def __init__(self, looked: _Looked, link: int) -> None:
        self.looked, self.link, arm = looked, link, looked.arm
        self.chain = np.flatnonzero(arm.carries[:, link]).tolist()
        self.origin, self.up = heights(arm, looked.command, link)
        self.levers = [_lever(arm, looked.q, link, j) for j in self.chain]
        mass, *moment = arm.inertial[link, :4]
        self.centre = np.array(moment) / mass if mass > 1e-9 else np.zeros(3)
        length = float(np.linalg.norm(arm.offset, axis=1).sum() + np.linalg.norm(self.centre))
        self.near = NEAR * max(length, SHORTEST_ARM_M)

    def surface(self) -> tuple[float, Surface] | None:
        """Part of the squared errors that a surface takes, and the surface; None if none is clearly there."""
        scale = [self.near, self.near, self.near, 0.3 * self.near]
        levels = np.quantile(self.origin + self.centre @ self.up, HEIGHT_SHARES)
        starts = [np.append(self.centre, level) for level in levels]
        ends = [np.asarray(least_squares(self._left, x, x_scale=scale, max_nfev=40).x) for x in starts]
        return max((found for x in ends if (found := self._clearly(x))), key=lambda each: each[0], default=None)

    def _made(self, x: Array) -> list[Array]:
        """Errors that the surface makes at each joint of the chain, by the best stiffness of each, (K,)."""
        depth = np.maximum(0.0, x[3] - self.origin - x[:3] @ self.up)
        out = []
        for j, (own, turned) in zip(self.chain, self.levers, strict=True):
            push = -depth * (own + x[:3] @ turned)
            push = push - self.looked.besides[j] @ (self.looked.besides[j].T @ push)
            stiffness = max(0.0, float(push @ self.looked.error[:, j])) / max(float(push @ push), 1e-12)
            out.append(stiffness * push)
        return out

    def _left(self, x: Array) -> Array:
        errors = self.looked.error
        rest = [errors[:, j] - made for j, made in zip(self.chain, self._made(x), strict=True)]
        return np.concatenate([*rest, FIRMLY * np.sqrt(len(errors)) * (x[:3] - self.centre) / self.near])

    def _clearly(self, x: Array) -> tuple[float, Surface] | None:
        """The same of one x; None if it does not show at enough joints, or nowhere or everywhere."""
        below = self.origin + x[:3] @ self.up < x[3]
        if below.sum() < FEWEST or below.mean() > MOST:
            return None
        taken, signs = 0.0, {}
        for j, made in zip(self.chain, self._made(x), strict=True):
            error = self.looked.error[:, j]
            falls = error**2 - (error - made) ** 2
            taken += float(falls.sum())
            share = float(falls[below].sum() / max(float(np.sum(error[below] ** 2)), 1e-12))
            signs[j] = share, float(np.quantile(np.abs(made[below]), 0.9))
        shown = tuple(j for j in self.chain if _shows(signs[j], ALSO))
        if len(shown) < JOINTS or not any(_shows(signs[j], SURE) for j in shown):
            return None
        return taken, Surface(self.link, x[:3], self._reached(x), shown)

    def _reached(self, x: Array) -> float:
        """Height up to which the point is where it is commanded to be well below the surface."""
        depth = x[3] - self.origin - x[:3] @ self.up
        origin, up = heights(self.looked.arm, self.looked.q, self.link)
        deep = depth >= np.median(depth[depth > 0.0])
        return float(np.quantile((origin + x[:3] @ up)[deep], PRESSED))


def _shows(sign: tuple[float, float], least: tuple[float, float]) -> bool:
    return sign[0] >= least[0] and sign[1] >= least[1]


def _direction(v: Array) -> Array:
    """Sign of the last motion [-1, 0, 1], (K,): friction holds a joint on the side that it came from."""
    moves = np.where(np.abs(v) > REST, np.arange(len(v)), -1)
    last = np.maximum.accumulate(moves)
    return np.where(last < 0, 0.0, np.sign(v[last]))


def _lever(arm: RigidArm, q: Array, link: int, joint: int) -> tuple[Array, Array]:
    """Derivative of `heights` of a link with respect to one joint."""
    step = np.zeros(arm.n)
    step[joint] = 1e-4
    ahead, behind = heights(arm, q + step, link), heights(arm, q - step, link)
    return (ahead[0] - behind[0]) / 2e-4, (ahead[1] - behind[1]) / 2e-4
