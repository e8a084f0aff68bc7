"""The arm as the page draws it: joint axes in space, and a line through every link."""

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm, model_chain
from calib.daemon.view import DrawnArm, DrawnJoint
from gcomp.arm.arm import Arm
from gcomp.arm.load import PlacedChain
from gcomp.arrays import Array


def drawn_arm(arm_file: ArmFile) -> DrawnArm:
    """The arm of an arm file, in the base frame, or its model's world frame; raises BadInput or OSError.

    At joint positions q, link i stands where the rotations by q_j − reference_j about axes j ≤ i bring it, the last
    one first.
    """
    arm = gcomp_arm(arm_file)  # which also says what is wrong with a model file
    if arm_file.model_path is None:
        gravity, reference, (axes, links) = arm.gravity, np.zeros(arm.n), _of_rows(arm)
    else:
        placed = model_chain(arm_file)
        gravity, reference, (axes, links) = placed.model.opt.gravity, placed.reference, _of_model(placed)
    if len(links[-1]) < 2:  # a last link without length gets a stub of 8 cm
        links[-1] = np.stack([links[-1][0], links[-1][0] + 0.08 * axes[-1]])
    size = float(np.linalg.norm(gravity))
    up = -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
    joints = [
        {"joint": name, "axis": axis.tolist(), "point": link[0].tolist(), "reference": zero, "link": link.tolist()}
        for name, axis, zero, link in zip(arm.names, axes, reference, links, strict=True)
    ]
    return DrawnArm(up=up.tolist(), joints=tuple(map(DrawnJoint.model_validate, joints)))


def _of_rows(arm: Arm) -> tuple[Array, list[Array]]:
    """Axes and links of Denavit-Hartenberg rows: a link leads along its joint's axis by d, then along x by a."""
    rotation, origin = np.eye(3), np.zeros(3)
    axes, links = np.empty((arm.n, 3)), []
    for i in range(arm.n):
        axes[i] = rotation[:, 2]
        rotation = rotation @ _turn(arm.theta_offset[i], 2)
        foot = origin + arm.d[i] * rotation[:, 2]
        end = foot + arm.a[i] * rotation[:, 0]
        links.append(_corners(origin, foot, end))
        rotation, origin = rotation @ _turn(arm.alpha[i], 0), end
    return axes, links


def _of_model(placed: PlacedChain) -> tuple[Array, list[Array]]:
    """Axes and links: straight from joint to joint, the last link to the body of it that is farthest away."""
    anchors, ends = placed.anchors, [placed.data.xpos[body] for body in placed.bodies[-1]]
    tip = max(ends, key=lambda end: float(np.linalg.norm(end - anchors[-1])))
    links = [_corners(start, end) for start, end in zip(anchors, [*anchors[1:], tip], strict=True)]
    return placed.geometry.bar[:, :, 2], links


def _corners(*points: Array) -> Array:
    """The points without those that repeat the one before."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > 1e-6:
            kept.append(point)
    return np.array(kept)


def _turn(angle: float, axis: int) -> Array:
    """Rotation matrix about the x (0) or z (2) axis."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == 0:
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
