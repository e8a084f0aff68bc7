"""A joint controller's units (per mille of rated torque, user position units, µN·m) in SI, from it or the arm file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from armlink.arm_file import LinkJoint
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.settings import CanopenSettings
from armlink.errors import BadInput, BusFault

TORQUE_PER_MICRO = 1e-6
"""2100h:01 is in µN·m."""
RATED_TORQUE_TOLERANCE = 1e-3
REVOLUTIONS, RADIANS, DEGREES = 0xB4, 0x10, 0x41
"""Units in 60A8h and 60A9h (CiA 303-2): bits 16 to 23; of a velocity bits 8 to 15 are the time; a power of ten is in
bits 24 to 31 of both."""
SECOND, MINUTE = 0x03, 0x47

USER_UNITS = 1 << 20
"""User units per joint revolution (6092h) of our controllers, assumed where it is not read from them."""


@dataclass(frozen=True)
class Units:
    """Scales of one joint: wire value times scale gives SI."""

    torque: float
    """One per mille of the rated torque (6076h) [N·m]."""
    position: float
    """One user unit [rad]."""
    velocity: float
    """One unit of 606Ch [rad/s]; by CiA 402 a user unit a second."""
    encoder_step: float
    """One encoder increment at the joint [rad]: the resolution of position readings."""


def units_from(rated_torque_mnm: int, encoder: tuple[int, int], gear: tuple[int, int], feed: tuple[int, int]) -> Units:
    """Scales by CiA 402 from 6076h [mN·m], 608Fh (increments, motor revolutions), 6091h (motor, shaft revolutions) and
    6092h (feed, shaft revolutions): user units = increments · 6092 / (608F · 6091), so 6092h is user units per joint
    revolution.

    Raises ValueError on a zero.
    """
    if not all((rated_torque_mnm, *encoder, *gear, *feed)):
        raise ValueError(
            f"one of 6076h ({rated_torque_mnm}), 608Fh ({encoder}), 6091h ({gear}) and 6092h ({feed}) contains a zero"
        )
    increments_a_turn = encoder[0] / encoder[1] * gear[0] / gear[1]
    unit, step = 2 * math.pi * feed[1] / feed[0], 2 * math.pi / increments_a_turn
    return Units(torque=rated_torque_mnm * 1e-6, position=unit, velocity=unit, encoder_step=step)


def told_units(services: NodeServices, rated_torque_mnm: int) -> Units:
    """Scales by what a device tells of encoder, gear and feed; raises ValueError on a zero, BusFault."""
    entries = (
        (objects.ENCODER_INCREMENTS, objects.ENCODER_REVOLUTIONS),
        (objects.GEAR_MOTOR, objects.GEAR_SHAFT),
        (objects.FEED, objects.FEED_SHAFT),
    )
    encoder, gear, feed = ((int(services.read(one)), int(services.read(other))) for one, other in entries)
    return units_from(rated_torque_mnm, encoder, gear, feed)


def assumed_units(joints: Sequence[LinkJoint]) -> tuple[Units, ...]:
    """Scales from the arm file's rated torques and USER_UNITS per revolution, for listeners, which read no objects.

    Raises BadInput for a rated torque that 6076h cannot hold: an UNSIGNED32 in mN·m.
    """
    for joint in joints:
        if not 0.5 < joint.rated_torque * 1e3 < 2**32:
            what = f"{joint.name}: rated_torque {joint.rated_torque:g} N·m"
            raise BadInput(f"{what}: expected 0.001 to {2**32 // 1000} N·m, as object 6076h holds it")
    return tuple(units_from(round(joint.rated_torque * 1e3), (1, 1), (1, 1), (USER_UNITS, 1)) for joint in joints)


def read_units(services: NodeServices, joint: LinkJoint) -> Units:
    """Scales of a joint at the output of its drive.

    Raises BadInput where the rated torque is not the arm file's or a scale is told by nobody, BusFault.
    """
    settings: CanopenSettings = joint.settings
    if settings.torque != "record":
        return _stock_units(services, joint, settings)
    rated_mnm = int(services.read(objects.RATED_TORQUE))
    _require_rated(joint, rated_mnm * 1e-3, joint.rated_torque)
    try:
        return told_units(services, rated_mnm)
    except ValueError as error:
        where = f"{joint.name} (node {settings.node})"
        raise BusFault(f"{where}: the scales of its drive are not usable: {error}: set these objects") from None


def _stock_units(services: NodeServices, joint: LinkJoint, settings: CanopenSettings) -> Units:
    """Scales of a stock device. The rated torque of the arm file is the joint's, that of the device at its output."""
    rated = joint.rated_torque / settings.gear
    told = _optional(services, objects.RATED_TORQUE)
    if told and not math.isclose(told * 1e-6, rated, rel_tol=RATED_TORQUE_TOLERANCE):  # some makers have it in µN·m
        _require_rated(joint, told * 1e-3, rated)
    position = settings.position_unit or _position_unit(services)
    if position is None:
        raise BadInput(
            f"{joint.name} ({settings.address}): 6092h, 608Fh and 60A8h do not give the unit of 6064h: write "
            "`position_unit` (radians of one count) in the `drive:` section of this joint"
        )
    velocity = settings.velocity_unit or _velocity_unit(services, position)
    return Units(rated * 1e-3, position, velocity, position)


def unit_doubt(services: NodeServices, joint: LinkJoint) -> str:
    """How the arm file's position_unit contradicts the device's own objects; empty where it does not."""
    given = getattr(joint.settings, "position_unit", None)
    own = _position_unit(services) if given else None
    if not given or not own or math.isclose(given, own, rel_tol=RATED_TORQUE_TOLERANCE):
        return ""
    return (
        f"{joint.name} ({joint.settings.address}): drive.position_unit is {given / own:.3g} times the unit that 6092h, "
        f"60A8h or 608Fh of the device give; if position_unit is wrong, the joint turns {own / given:.3g} times as "
        "fast and as far as its readings say: before anything else, run `armlink check ARM --scales hand`"
    )


def _position_unit(services: NodeServices) -> float | None:
    """Radians at the output of one count of 6064h: by 6092h, else by 60A8h, else by 608Fh and 6091h."""
    feed, shaft = _optional(services, objects.FEED), _optional(services, objects.FEED_SHAFT) or 1
    if feed:
        return 2 * math.pi * shaft / feed
    told = _optional(services, objects.POSITION_SI_UNIT)
    if told and (turn := _angle(told)) is not None:
        return turn
    increments = _optional(services, objects.ENCODER_INCREMENTS)
    if not increments:
        return None
    turns = _optional(services, objects.ENCODER_REVOLUTIONS) or 1
    motor, gear = gear_turns(services)
    return 2 * math.pi * turns / increments * gear / motor


def _velocity_unit(services: NodeServices, position: float) -> float:
    """Radians a second at the output of one count of 606Ch: by 60A9h, else counts of 6064h a second (CiA 402)."""
    told = _optional(services, objects.VELOCITY_SI_UNIT)
    time = {SECOND: 1.0, MINUTE: 60.0}.get(told >> 8 & 0xFF)
    if not told or time is None:
        return position
    angle = _angle(told)
    if angle is None:
        return position / time * _power(told)
    motor, gear = gear_turns(services)
    return angle / time * gear / motor


def gear_turns(services: NodeServices) -> tuple[int, int]:
    """Turns of the motor and of the output that belong together, by 6091h; 1 and 1 where the device does not tell."""
    return _optional(services, objects.GEAR_MOTOR) or 1, _optional(services, objects.GEAR_SHAFT) or 1


def _angle(told: int) -> float | None:
    """Radians of the unit in 60A8h or 60A9h; None for increments and what is no angle."""
    angle = {REVOLUTIONS: 2 * math.pi, RADIANS: 1.0, DEGREES: math.pi / 180}.get(told >> 16 & 0xFF)
    return None if angle is None else angle * _power(told)


def _power(told: int) -> float:
    exponent = told >> 24 & 0xFF
    return float(10.0 ** (exponent - 256 if exponent > 127 else exponent))


def _optional(services: NodeServices, entry: Entry) -> int:
    """Value of an object, 0 where the device lacks it."""
    return int(services.read(entry)) if services.has(entry) else 0


def _require_rated(joint: LinkJoint, found: float, stated: float) -> None:
    if abs(found - stated) > RATED_TORQUE_TOLERANCE * stated:
        raise BadInput(
            f"{joint.name} ({joint.settings.address}): rated torque 6076h is {found} N·m, but the arm file "
            f"has {stated} N·m: correct link.joints, or connect the right arm"
        )
