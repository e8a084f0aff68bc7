"""Conversion between a joint controller's units (per mille of rated torque, user position units, µN·m) and SI."""

import math
from dataclasses import dataclass

from armlink.arm_file import ArmFile

TORQUE_PER_MICRO = 1e-6
"""2100h:01 is in µN·m."""
USER_UNITS = 1 << 20
"""User units per joint revolution, assumed if 6092h is not read from the controllers."""


@dataclass(frozen=True)
class Units:
    """Scales of one joint: wire value times scale gives SI."""

    torque: float
    """One per mille of the rated torque (6076h) [N·m]."""
    position: float
    """One user unit [rad]; velocities are in user units a second."""
    encoder_step: float
    """One encoder increment at the joint [rad]: the resolution of position readings."""


def units_from(
    rated_torque_mnm: int,
    encoder: tuple[int, int],
    gear: tuple[int, int],
    feed: tuple[int, int],
) -> Units:
    """Scales by CiA 402 from 6076h [mN·m], 608Fh (increments, motor revolutions), 6091h (motor, shaft revolutions) and
    6092h (feed, shaft revolutions): user units = increments · 6092 / (608F · 6091), so 6092h is user units per joint
    revolution.

    Raises ValueError on a zero.
    """
    if not all((rated_torque_mnm, *encoder, *gear, *feed)):
        raise ValueError(f"a zero in 6076h {rated_torque_mnm}, 608Fh {encoder}, 6091h {gear} or 6092h {feed}")
    increments_a_turn = encoder[0] / encoder[1] * gear[0] / gear[1]
    return Units(
        torque=rated_torque_mnm * 1e-6,
        position=2 * math.pi * feed[1] / feed[0],
        encoder_step=2 * math.pi / increments_a_turn,
    )


def assumed_units(arm: ArmFile) -> tuple[Units, ...]:
    """Scales from the arm file's rated torques and USER_UNITS per revolution, for listeners, which read no objects."""
    joints = arm.require_link().joints
    return tuple(units_from(round(joint.rated_torque * 1e3), (1, 1), (1, 1), (USER_UNITS, 1)) for joint in joints)
