"""The gate's limits of an arm, from its file."""

from collections.abc import Sequence

from armlink.arm_file import ArmFile, LinkJoint, LinkSection
from armlink.drives.orders import Gains, Limits, ReadingRange
from armlink.errors import BadInput, Refused
from armlink.link.gate import ROUNDING_FACTOR, JointLimits
from armlink.model_file import compile_model

POSITION_GAIN_ERROR = 0.02
"""A position sensor may read so much more of its range than is true: the stops are found beyond their nominal place."""
PRESS_DEPTH = 0.05
"""A target may lie this far behind a stop [rad], so that a joint can be pressed against it."""
OVERSPEED = 1.4
"""A joint under torque control is refused this many times as fast as max_velocity: it then stops before 1.5 times."""
SERVO_OVERSPEED = 3.0
"""A joint under position control may, as it takes up a load, turn this many times as fast as max_velocity."""
SERVO_SPEED = 3.0
"""A joint under position control may turn this fast whatever max_velocity is [rad/s]: one that is enabled while it
sinks is caught at that speed."""
FOLLOWING_ERROR = 0.5
"""A joint under position control may read a position this far from its target before it is stopped [rad]; a motion of
calib takes a joint for blocked long before."""
WINDOW_MARGIN = 0.1
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
            raise BadInput(
                f"{arm.path}: link.joints names the joint {joint.name}, but {arm.model_path} has no such joint"
            )
        if joint.name not in arm.kinematics.stops and not model.jnt_limited[index]:
            raise BadInput(
                f"{arm.model_path}: joint {joint.name} has no range: give its stops [rad] in the arm file, for "
                f"example `kinematics: {{stops: {{{joint.name}: [-3.0, 3.0]}}}}`"
            )
        lower, upper = arm.kinematics.stops.get(joint.name, model.jnt_range[index])
        ranges.append((float(lower), float(upper)))
    return tuple(ranges)


def target_window(lower: float, upper: float) -> tuple[float, float]:
    """Where a position target may lie [rad]: the stops, the position sensor's error, and some press-in."""
    margin = POSITION_GAIN_ERROR * max(-lower, upper) + PRESS_DEPTH
    return lower - margin, upper + margin


def require_ranges(
    name: str, ranges: Sequence[ReadingRange], gate: JointLimits, row: LinkJoint, ends: tuple[float, float]
) -> None:
    """Raise Refused where a drive's readings end before a limit of the gate: what is beyond could never be seen.

    `ends` of the target window at the drive's output [rad], in either order.
    """
    gear = abs(row.settings.gear)
    needed = {
        "position": (
            max(map(abs, ends)) + gate.outside * gear,
            "rad",
            "correct zero and direction in the arm file, or give the joint a smaller range",
        ),
        "velocity": (max(gate.overspeed, gate.servo_overspeed) * gear, "rad/s", "lower max_velocity"),
        "torque": (gate.most_sent / gear, "N·m", "lower max_torque"),
    }
    for quantity, largest, where, remedy in ranges:
        least, unit, otherwise = needed[quantity]
        if largest * ROUNDING_FACTOR < least:  # registers hold 32-bit floats
            raise Refused(
                f"{name}: {where} limits the {quantity} readings to {largest:.6g} {unit}, but the gate must be "
                f"able to read {least:.6g} {unit}: {remedy}, or {otherwise}"
            )


def drive_limits(joint: LinkJoint, window: tuple[float, float], period: float, deadline: float) -> Limits:
    """Limits of one joint with its target window [rad], as a drive family gets them."""
    return Limits(
        max_torque=joint.max_torque,
        torque_rate=joint.max_torque_rate,
        max_velocity=joint.max_velocity,
        lower=window[0],
        upper=window[1],
        deadline=deadline,
        period=period,
    )


def arm_limits(section: LinkSection, stops: Sequence[tuple[float, float]]) -> list[Limits]:
    """Limits of every joint by the arm file, with its stops [rad]."""
    rows = zip(section.joints, stops, strict=True)
    return [drive_limits(row, target_window(*ends), 1.0 / section.rate, section.deadline) for row, ends in rows]


def gate_limits(limits: Limits, gains: Gains | None = None, max_torque: float | None = None) -> JointLimits:
    """Limits for the gate of one joint; `gains` of a drive without an integral term, `max_torque` where a calibration
    in the host leaves less than the arm file's [N·m]."""
    return JointLimits(
        max_torque=limits.max_torque if max_torque is None else max_torque,
        torque_step=limits.torque_rate * limits.period,
        position_step=limits.max_velocity * limits.period,
        lower=limits.lower,
        upper=limits.upper,
        overspeed=OVERSPEED * limits.max_velocity,
        servo_overspeed=max(SERVO_OVERSPEED * limits.max_velocity, SERVO_SPEED),
        following=FOLLOWING_ERROR,
        outside=WINDOW_MARGIN,
        max_age=limits.deadline,
        period=limits.period,
        kp=gains.kp if gains else 0.0,
        kd=gains.kd if gains else 0.0,
        most_sent=limits.max_torque,
    )
