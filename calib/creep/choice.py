"""Whether an arm is swept by creeping or by steps at rest."""

from collections.abc import Sequence
from typing import Literal

from armlink.arm_file import ArmFile
from armlink.drives.registry import family
from armlink.errors import BadInput
from calib.arm.sweep_section import sweep_section
from calib.sweep.dataset import SweepData

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
    """Whether a data set was swept by creeping."""
    return data.plan is not None and any(sweep.speed is not None for sweep in data.plan.sweeps)


def all_creep(data: Sequence[SweepData]) -> bool:
    """Whether the data sets are creep sweeps; raises BadInput where some are and some are not."""
    kinds = {is_creep(each) for each in data}
    if len(kinds) > 1:
        other = next(each for each in data if not is_creep(each))
        raise BadInput(f"{other.path}: steps at rest, but the other directories are creep sweeps: give one kind")
    return kinds == {True}
