"""Whether an arm is swept by creeping or by steps at rest, and what no creep of it can show by its geometry alone."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.registry import family
from armlink.errors import BadInput
from calib.arm.sweep_section import sweep_section
from calib.sweep.dataset import SweepData
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_levers, gravity_regressor

Motion = Literal["creep", "steps"]


def sweep_motion(arm_file: ArmFile) -> Motion:
    """`sweep.motion` of the arm file; without it creep where the torque of every drive is a motor current.

    At rest friction holds a joint at any torque within its band, and a motor current cannot tell friction from gravity;
    a torque sensor behind the friction can.
    """
    stated = sweep_section(arm_file).motion
    if stated is not None:
        return stated
    joints = arm_file.require_link().joints
    return "creep" if all(family(each.settings.family).traits.torque == "current" for each in joints) else "steps"


def is_creep(data: SweepData) -> bool:
    return data.plan is not None and any(sweep.speed is not None for sweep in data.plan.sweeps)


def all_creep(data: Sequence[SweepData]) -> bool:
    """Whether the data sets are creep sweeps; raises BadInput where some are and some are not."""
    kinds = {is_creep(each) for each in data}
    if len(kinds) > 1:
        other = next(each for each in data if not is_creep(each))
        raise BadInput(f"{other.path}: steps at rest, but the other directories are creep sweeps: give one kind")
    return kinds == {True}


VERTICAL = (
    "its axis is vertical in every pose, so that gravity does not load it: its torque constant cannot be seen; mount"
    " the base tilted by 10° or more and state kinematics.gravity accordingly"
)
NO_LEVER = (
    "the axes of all joints that gravity loads meet in one point, or nearly, so that a mass at an unknown place has no"
    " known lever: torque constants share one unknown factor; measure where the mass hangs (sweep.reference_point)"
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
