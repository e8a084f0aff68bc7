"""Levers on an arm, without which no creep tells a torque constant: of gravity on a joint, and of the mass."""

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_levers, gravity_regressor

VERTICAL = (
    "its axis is vertical in every pose, so gravity does not load it and its torque constant cannot be "
    "determined; mount the base tilted by 10° or more and write the tilt as kinematics.gravity"
)
NO_LEVER = (
    "the axes of all joints that gravity loads meet (nearly) in one point, so the distance of the mass from them is "
    "unknown, and all torque constants share one unknown factor; measure where the mass hangs (sweep.reference_point)"
)
SHORTEST = 0.005
"""Lever below which the place of the mass hides it [m], root mean square over poses."""


def is_vertical(arm: Arm, joint: int) -> bool:
    """Whether a joint's axis is along gravity in every pose."""
    poses = np.random.default_rng(1).uniform(-1.5, 1.5, (20, arm.n))
    return bool(np.all(gravity_levers(arm, poses)[:, joint] < 0.02 * np.linalg.norm(arm.gravity)))


def known_lever(arm: Arm) -> float:
    """Lever of a mass whose place on the last link is not known [m]: what the place cannot take up, RMS over poses."""
    poses = np.random.default_rng(1).uniform(-1.5, 1.5, (50, arm.n))
    regressor = gravity_regressor(arm, poses)
    at_origin, by_point = payload_columns(arm)
    lever, moved = (regressor @ at_origin).ravel(), (regressor @ by_point).reshape(-1, 3)
    rest = lever - moved @ np.linalg.lstsq(moved, lever, rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2)) / np.linalg.norm(arm.gravity))
