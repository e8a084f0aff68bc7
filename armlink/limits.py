"""The gate's limits of an arm, from its file and its controllers' units."""

import math

import numpy as np
from numpy.typing import NDArray

from armlink.armfile import ArmFile, LinkSection
from armlink.errors import BadInput
from armlink.gate import Limits
from armlink.units import Units

POSITION_GAIN_ERROR = 0.02
"""A position sensor may read so much more of its range than is true: the stops are found beyond their nominal place."""
PRESS_IN = 0.05
"""A target may lie so far behind a stop [rad], so that a joint can be pressed against it."""


def joint_ranges(arm: ArmFile) -> tuple[tuple[float, float], ...]:
    """Lower and upper stop of each linked joint [rad]; from the model file where the arm file has no rows."""
    if arm.kinematics.joints:
        return tuple((joint.lower, joint.upper) for joint in arm.kinematics.joints)
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(arm.model_path))
    except ValueError as error:
        raise BadInput(f"{arm.model_path}: {error}") from None
    ranges = []
    for joint in arm.require_link().joints:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if index < 0:
            raise BadInput(f"{arm.path}: link.joints names {joint.name}, which {arm.model_path} has not")
        if not model.jnt_limited[index]:
            raise BadInput(f"{arm.model_path}: joint {joint.name} has no range: give its stops [rad]")
        ranges.append((float(model.jnt_range[index][0]), float(model.jnt_range[index][1])))
    return tuple(ranges)


def target_window(lower: float, upper: float) -> tuple[float, float]:
    """Where a position target may lie [rad]: the stops, the position sensor's error, and some press-in."""
    margin = POSITION_GAIN_ERROR * max(abs(lower), abs(upper)) + PRESS_IN
    return lower - margin, upper + margin


def gate_limits(section: LinkSection, windows: NDArray[np.float64], units: tuple[Units, ...]) -> Limits:
    """Limits for the gate; `windows` (n, 2) [rad]."""
    joints = section.joints

    def each(name: str) -> NDArray[np.float64]:
        return np.array([getattr(joint, name) for joint in joints], dtype=np.float64)

    return Limits(
        max_torque=each("max_torque"),
        max_torque_rate=each("max_torque_rate"),
        max_velocity=each("max_velocity"),
        lower=windows[:, 0].copy(),
        upper=windows[:, 1].copy(),
        torque_unit=np.array([unit.torque for unit in units]),
        position_unit=np.array([unit.position for unit in units]),
        max_command_age=section.deadline,
        max_sample_age=section.deadline,
    )


def milliseconds(seconds: float) -> int:
    """Whole milliseconds, at least one."""
    return max(1, math.ceil(seconds * 1e3 - 1e-9))
