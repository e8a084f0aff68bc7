"""Joint axes in space to standard Denavit-Hartenberg rows, also for parallel and intersecting axes."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array

NEARLY_PARALLEL = 0.1
"""Sine of the angle below which two axes have their origins near the arm instead of on their common normal, which would
be ten times as far away as they are from each other, and kilometres where an angle of the model is rounded."""
ROUNDING = 1e-9
"""Sine of an angle that is rounding of the computation alone: such axes are parallel."""


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """An arm with the placement of its bar frames in the reference configuration."""

    arm: Arm
    bar: Array
    """Bar frames' axes in the world frame (n, 3, 3), columns x̄_i, ȳ_i, z_{i-1}."""
    origins: Array
    """Origins of the bar frames (n, 3) [m], world frame, each on its joint's axis."""


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
    alpha, theta, span = np.zeros(n), np.zeros(n), np.zeros((n, 3))
    bar, origins = np.empty((n, 3, 3)), np.empty((n, 3))
    for i, axis in enumerate(axes):
        origins[i] = origin
        following = axes[i + 1] if i + 1 < n else axis
        next_origin = _next_origin(origin, axis, points[i + 1], following) if i + 1 < n else origin
        normal = np.cross(axis, following)
        across = next_origin - origin - ((next_origin - origin) @ axis) * axis
        parallel, along_one_line = np.linalg.norm(normal) < ROUNDING, np.linalg.norm(across) < 1e-12
        next_x = normal if not parallel else x if along_one_line else across
        next_x = next_x - (next_x @ axis) * axis
        next_x /= np.linalg.norm(next_x)
        bar[i] = np.stack([next_x, np.cross(axis, next_x), axis], axis=1)
        theta[i] = np.arctan2(np.cross(x, next_x) @ axis, x @ next_x)
        alpha[i] = np.arctan2(np.cross(axis, following) @ next_x, axis @ following)
        span[i] = bar[i].T @ (next_origin - origin)
        x, origin = next_x, next_origin
    a, b, d = span.T
    arm = Arm(names, alpha, a, d, theta - reference, base.T @ gravity, limits[:, 0], limits[:, 1], b)
    return ArmGeometry(arm, bar, origins)


def _next_origin(origin: Array, axis: Array, point: Array, following: Array) -> Array:
    """Origin on the line (point, following): foot of the common normal with (origin, axis), or the nearest in reach."""
    cosine, between = float(axis @ following), point - origin
    along, along_following = float(between @ axis), float(between @ following)
    sine = float(np.linalg.norm(np.cross(axis, following)))
    if sine < NEARLY_PARALLEL:
        nearest: Array = point - along_following * following
        return nearest
    foot: Array = point + (cosine * along - along_following) / sine**2 * following
    return foot


def _perpendicular(axis: Array) -> Array:
    """Unit vector perpendicular to `axis`, towards the world's x axis, or its y axis if x is along the axis."""
    towards = np.eye(3)[0 if abs(axis[0]) < 0.9 else 1]
    across = towards - (towards @ axis) * axis
    perpendicular: Array = across / np.linalg.norm(across)
    return perpendicular
