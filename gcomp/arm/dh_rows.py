"""Joint axes in space to standard Denavit-Hartenberg rows, also for parallel and intersecting axes."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array

PARALLEL = 1e-6
"""Axes at a smaller angle [rad] get the lengths a and d of parallel ones, since their common normal is ill-conditioned;
their angle is kept."""


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """An arm with the placement of its bar frames in the reference configuration."""

    arm: Arm
    bar: Array
    """Bar frames' axes in the world frame (n, 3, 3), columns x̄_i, ȳ_i, z_{i-1}."""
    span: Array
    """From joint i's point to joint i+1's in bar frame i (n, 3); the last is zero [m]."""

    def base_parameters(self, mass: Array, first_moment: Array) -> Array:
        """Mass moments β (2n,) of links: masses (n,), first moments (n, 3) in bar frames from the joint points.

        Equation (R) of docs/theory.md, with any points of the axes in place of the Denavit-Hartenberg origins.
        """
        arm, along_axis, distal_mass = self.arm, 0.0, 0.0
        beta = np.empty((arm.n, 2))
        for i in reversed(range(arm.n)):
            next_axis = np.array([0.0, -np.sin(arm.alpha[i]), np.cos(arm.alpha[i])])
            moment = first_moment[i] + distal_mass * self.span[i] + along_axis * next_axis
            beta[i], along_axis = moment[:2], float(moment[2])
            distal_mass += float(mass[i])
        return beta.ravel()


def axes_to_arm(
    names: tuple[str, ...], axes: Array, points: Array, reference: Array, gravity: Array, limits: Array
) -> ArmGeometry:
    """The arm whose joint i turns by q_i − reference_i about unit vector axes_i through points_i (n, 3), world frame.

    Frame 0 has z_0 along the first axis and x_0 towards the world's x (or y) axis; gravity (3,) is given in the world
    frame and turned into frame 0. limits (n, 2) are lower and upper joint positions [rad].
    """
    n = len(names)
    x, origin = _perpendicular(axes[0]), points[0]
    base = np.stack([x, np.cross(axes[0], x), axes[0]], axis=1)
    a, d, alpha, theta, bar = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.empty((n, 3, 3))
    for i, axis in enumerate(axes):
        following = axes[i + 1] if i + 1 < n else axis
        target = points[i + 1] if i + 1 < n else origin
        normal = np.cross(axis, following)
        sine = float(np.linalg.norm(normal))
        between = target - origin
        across = between - (between @ axis) * axis
        if sine > PARALLEL:
            next_x = normal / sine
            foot, next_origin = _feet(origin, axis, target, following, between)
        else:
            length = float(np.linalg.norm(across))
            next_x = normal / sine if sine > 0 else across / length if length > 1e-12 else x
            foot, next_origin = origin, origin + across
        next_x = next_x - (next_x @ axis) * axis
        next_x /= np.linalg.norm(next_x)
        bar[i] = np.stack([next_x, np.cross(axis, next_x), axis], axis=1)
        theta[i] = np.arctan2(np.cross(x, next_x) @ axis, x @ next_x)
        alpha[i] = np.arctan2(np.cross(axis, following) @ next_x, axis @ following)
        d[i], a[i] = (foot - origin) @ axis, (next_origin - foot) @ next_x
        x, origin = next_x, next_origin
    arm = Arm(names, alpha, a, d, theta - reference, base.T @ gravity, limits[:, 0], limits[:, 1])
    span = np.einsum("ndk,nd->nk", bar, np.diff(points, axis=0, append=points[-1:]))
    return ArmGeometry(arm, bar, span)


def _feet(origin: Array, axis: Array, target: Array, following: Array, between: Array) -> tuple[Array, Array]:
    """Feet of the common normal on the line (origin, axis) and on the line (target, following)."""
    cosine = axis @ following
    along, along_following = between @ axis, between @ following
    sine_squared = float(np.sum(np.cross(axis, following) ** 2))
    first = (along - cosine * along_following) / sine_squared
    second = (cosine * along - along_following) / sine_squared
    return origin + first * axis, target + second * following


def _perpendicular(axis: Array) -> Array:
    """Unit vector perpendicular to `axis`, towards the world's x axis, or its y axis if x is along the axis."""
    towards = np.eye(3)[0 if abs(axis[0]) < 0.9 else 1]
    across = towards - (towards @ axis) * axis
    perpendicular: Array = across / np.linalg.norm(across)
    return perpendicular
