"""The arm as gravity sees it: Denavit-Hartenberg rows, gravity in the base frame, joint range."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arrays import Array, as_array, cross, frozen
from gcomp.errors import BadArray


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm of n revolute joints in standard Denavit-Hartenberg form (docs/theory.md, section 1).

    Joint i turns about z_{i-1} by θ_i = q_i + theta_offset_i. Raises BadArray on wrong shapes or an empty range.

    The common normal of nearly parallel axes, such as those of a model with rounded angles, lies kilometres away. There
    the origins stay on the axes near the arm, and the way between them has a third component `b`.
    """

    names: tuple[str, ...]
    alpha: Array
    """Link twists (n,) [rad]."""
    a: Array
    """Link lengths (n,) [m]."""
    d: Array
    """Link offsets (n,) [m]."""
    theta_offset: Array
    """Denavit-Hartenberg angle at joint position zero (n,) [rad]."""
    gravity: Array
    """Acceleration of gravity (3,) in the base frame [m/s²]."""
    lower: Array
    """Lower joint limit (n,) [rad]; -inf for none."""
    upper: Array
    """Upper joint limit (n,) [rad]; +inf for none."""
    b: ArrayLike = 0.0
    """Offsets of the origins along ȳ of the bar frames (n,) [m]; zero in Denavit-Hartenberg form."""

    def __post_init__(self) -> None:
        n = len(self.names)
        if n == 0 or len(set(self.names)) != n:
            raise BadArray(f"joint names are {list(self.names)}: expected at least one name, and no name twice")
        for key in ("alpha", "a", "d", "theta_offset"):
            frozen(self, **{key: as_array(key, getattr(self, key), (n,))})
        frozen(self, b=as_array("b", np.full(n, self.b) if np.ndim(self.b) == 0 else self.b, (n,)))
        frozen(self, names=tuple(self.names), gravity=as_array("gravity", self.gravity, (3,)))
        for key in ("lower", "upper"):
            frozen(self, **{key: as_array(key, getattr(self, key), (n,), finite=False)})
        for name, low, high in zip(self.names, self.lower, self.upper, strict=True):
            if not low < high:
                raise BadArray(f"joint {name}: lower {low} must be less than upper {high} [rad]")

    @property
    def n(self) -> int:
        return len(self.names)

    @cached_property
    def span(self) -> Array:
        """From each joint's origin to the next one's, in its bar frame (n, 3) [m]."""
        return np.stack([self.a, as_array("b", self.b, (self.n,)), self.d], axis=1)


@dataclass(frozen=True, eq=False)
class BarFrames:
    """Bar frames of K poses in the base frame: frame i is fixed to link i and turns with joint i about its z axis."""

    rotation: Array
    """B (K, n, 3, 3): columns x̄_i, ȳ_i and the joint axis z_{i-1}."""
    lever: Array
    """w_i = z_{i-1} × g (K, n, 3) [m/s²]; its length is Γ_i."""


def bar_rotations(arm: Arm, q: Array) -> Array:
    """Rotations of the bar frames at poses q (K, n) [rad]: B_1 = Rz(θ_1), B_{i+1} = B_i Rx(α_i) Rz(θ_{i+1})."""
    cos, sin = np.cos(q + arm.theta_offset), np.sin(q + arm.theta_offset)
    twist = np.append(0.0, arm.alpha[:-1])
    ca, sa = np.cos(twist), np.sin(twist)
    turn = np.empty((*q.shape, 3, 3))
    turn[..., 0, 0], turn[..., 1, 0], turn[..., 2, 0] = cos, ca * sin, sa * sin
    turn[..., 0, 1], turn[..., 1, 1], turn[..., 2, 1] = -sin, ca * cos, sa * cos
    turn[..., 0, 2], turn[..., 1, 2], turn[..., 2, 2] = 0.0, -sa, ca
    for i in range(1, arm.n):
        turn[:, i] = turn[:, i - 1] @ turn[:, i]
    return turn


def bar_frames(arm: Arm, q: Array) -> BarFrames:
    """Bar frames at poses q (K, n) [rad]."""
    rotation = bar_rotations(arm, q)
    return BarFrames(rotation, cross(rotation[..., 2], arm.gravity))
