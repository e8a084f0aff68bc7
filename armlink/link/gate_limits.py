"""The gate's limits of an arm, from its file and its controllers' units."""

import math

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.canopen.units import Units, assumed_units
from armlink.errors import BadInput
from armlink.link.gate import JointLimits
from armlink.model_file import compile_model

INT16_MAX, INT32_MAX, UINT32_MAX = 2**15 - 1, 2**31 - 1, 2**32 - 1
POSITION_GAIN_ERROR = 0.02
"""A position sensor may read so much more of its range than is true: the stops are found beyond their nominal place."""
PRESS_IN = 0.05
"""A target may lie this far behind a stop [rad], so that a joint can be pressed against it."""
OVERSPEED = 1.5
"""A joint under torque control may turn this many times as fast as max_velocity before it is stopped."""
SERVO_OVERSPEED = 3.0
"""A joint under position control may, as it takes up a load, turn this many times as fast as max_velocity."""
SERVO_SPEED = 3.0
"""A joint under position control may turn this fast whatever max_velocity is [rad/s]: one that is enabled while it
sinks is caught at that speed."""
FOLLOWING = 0.5
"""A joint under position control may read a position this far from its target before it is stopped [rad]; a motion of
calib takes a joint for blocked long before."""
OUTSIDE = 0.1
"""A joint under torque control may read a position this far outside the target window before it is stopped [rad]."""


def joint_ranges(arm: ArmFile) -> tuple[tuple[float, float], ...]:
    """Lower and upper stop of each linked joint [rad]; from the model file where the arm file has no rows."""
    if arm.kinematics.joints:
        return tuple((joint.lower, joint.upper) for joint in arm.kinematics.joints)
    import mujoco

    assert arm.model_path is not None
    model, ranges = compile_model(arm.model_path), []
    for joint in arm.require_link().joints:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if index < 0:
            raise BadInput(f"{arm.path}: link.joints names {joint.name}, which {arm.model_path} has not")
        if joint.name not in arm.kinematics.stops and not model.jnt_limited[index]:
            raise BadInput(
                f"{arm.model_path}: joint {joint.name} has no range: give its stops [rad] in the arm file, as"
                f" kinematics: {{stops: {{{joint.name}: [-3.0, 3.0]}}}}"
            )
        lower, upper = arm.kinematics.stops.get(joint.name, model.jnt_range[index])
        ranges.append((float(lower), float(upper)))
    return tuple(ranges)


def target_window(lower: float, upper: float) -> tuple[float, float]:
    """Where a position target may lie [rad]: the stops, the position sensor's error, and some press-in."""
    margin = POSITION_GAIN_ERROR * max(-lower, upper) + PRESS_IN
    return lower - margin, upper + margin


def gate_limits(
    joint: LinkJoint, window: tuple[float, float], unit: Units, period: float, max_age: float
) -> JointLimits:
    """Limits for the gate of one joint with its target window [rad] and the oldest reading that counts [s].

    Raises BadInput where they fit no frame.
    """
    if joint.max_torque / unit.torque > INT16_MAX:
        most = INT16_MAX * unit.torque
        raise BadInput(f"{joint.name}: max_torque {joint.max_torque} N·m: 6071h carries at most {most:.6g} N·m")
    if joint.max_velocity / unit.position > UINT32_MAX:
        most, speed = UINT32_MAX * unit.position, joint.max_velocity
        raise BadInput(f"{joint.name}: max_velocity {speed} rad/s: 6081h carries at most {most:.6g} rad/s")
    if joint.max_torque_rate / unit.torque > UINT32_MAX:
        most, rate = UINT32_MAX * unit.torque, joint.max_torque_rate
        raise BadInput(f"{joint.name}: max_torque_rate {rate} N·m/s: 6087h carries at most {most:.6g} N·m/s")
    if max(map(abs, window)) / unit.position > INT32_MAX:
        raise BadInput(f"{joint.name}: its range is more than 607Ah carries at {unit.position:.3g} rad a user unit")
    return JointLimits(
        max_torque=joint.max_torque,
        torque_step=joint.max_torque_rate * period,
        position_step=joint.max_velocity * period,
        lower=window[0],
        upper=window[1],
        torque_unit=unit.torque,
        position_unit=unit.position,
        overspeed=OVERSPEED * joint.max_velocity,
        servo_overspeed=max(SERVO_OVERSPEED * joint.max_velocity, SERVO_SPEED),
        following=FOLLOWING,
        outside=OUTSIDE,
        max_age=max_age,
    )


def try_limits(arm: ArmFile) -> None:
    """Raise BadInput where the limits of an arm file fit no controller with the usual units; asks no controller."""
    link = arm.require_link()
    rows = zip(link.joints, joint_ranges(arm), assumed_units(arm), strict=True)
    for joint, (lower, upper), unit in rows:
        gate_limits(joint, target_window(lower, upper), unit, 1.0 / link.rate, link.deadline)


def milliseconds(seconds: float) -> int:
    """Whole milliseconds, at least one."""
    return max(1, math.ceil(seconds * 1e3 - 1e-9))
