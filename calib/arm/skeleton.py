"""The arm as a drawing needs it: joint axes in space, and a line through every link."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm, model_chain
from gcomp.arm.arm import Arm
from gcomp.arm.load import PlacedChain
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Axes and links with every joint at its `reference`, in the base frame (for a model file its world frame).

    At joint positions q, link i stands where the rotations by q_j − reference_j about axes j ≤ i bring it, the last
    one first.
    """

    up: Array
    """Unit vector (3,) against gravity; z without gravity."""
    axes: Array
    """Unit vectors (n, 3)."""
    points: Array
    """A point of each axis (n, 3) [m]."""
    reference: Array
    """Joint positions (n,) [rad]."""
    links: tuple[Array, ...]
    """Corners of a line from each joint to the next, the last one to the tip; (m, 3) each [m]."""


def skeleton(arm_file: ArmFile) -> Skeleton:
    """The arm of an arm file; raises BadInput if its model file cannot be used."""
    arm = gcomp_arm(arm_file)  # which also says what is wrong with a model file
    if arm_file.model_path is None:
        return _of_rows(arm)
    return _of_model(model_chain(arm_file))


def _of_rows(arm: Arm) -> Skeleton:
    """From Denavit-Hartenberg rows: a link leads along its joint's axis by d, then along x by a."""
    rotation, origin = np.eye(3), np.zeros(3)
    axes, points, links = np.empty((arm.n, 3)), np.empty((arm.n, 3)), []
    for i in range(arm.n):
        axes[i], points[i] = rotation[:, 2], origin
        rotation = rotation @ _turn(arm.theta_offset[i], 2)
        foot = origin + arm.d[i] * rotation[:, 2]
        end = foot + arm.a[i] * rotation[:, 0]
        links.append(_corners(origin, foot, end))
        rotation, origin = rotation @ _turn(arm.alpha[i], 0), end
    return Skeleton(_up(arm.gravity), axes, points, np.zeros(arm.n), _with_tip(links, axes[-1]))


def _of_model(placed: PlacedChain) -> Skeleton:
    """From a model: straight from joint to joint, the last link to the body of it that is farthest away."""
    anchors, data = placed.anchors, placed.data
    ends = [data.xpos[body] for body in placed.bodies[-1]]
    tip = max(ends, key=lambda end: float(np.linalg.norm(end - anchors[-1])))
    links = [_corners(start, end) for start, end in zip(anchors, [*anchors[1:], tip], strict=True)]
    axes = placed.geometry.bar[:, :, 2]
    up = _up(placed.model.opt.gravity)
    return Skeleton(up, axes, anchors.copy(), placed.reference, _with_tip(links, axes[-1]))


def _with_tip(links: list[Array], axis: Array) -> tuple[Array, ...]:
    """The links; a last one without length gets a stub of 8 cm along the last axis."""
    if len(links[-1]) < 2:
        links[-1] = np.stack([links[-1][0], links[-1][0] + 0.08 * axis])
    return tuple(links)


def _corners(*points: Array) -> Array:
    """The points without those that repeat the one before."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > 1e-6:
            kept.append(point)
    return np.array(kept)


def _up(gravity: Array) -> Array:
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0 else np.array([0.0, 0.0, 1.0])


def _turn(angle: float, axis: int) -> Array:
    """Rotation matrix about the x (0) or z (2) axis."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == 0:
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
