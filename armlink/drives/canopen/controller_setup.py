"""Set-up of one joint's controller before the cycle starts: identity, units, limits, PDO mapping, read back."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from armlink.arm_file import DeviceIdentity, LinkJoint, LinkSection
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen.cia402 import CYCLIC_VELOCITY, MODE_NAMES, NEEDED_MODES, DriveState, state_of, supports
from armlink.drives.canopen.eds_file import expected_identity
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import Pdo
from armlink.drives.canopen.profile import OURS, Profile, examine_objects
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.settings import CanopenSettings
from armlink.drives.canopen.units import Units, gear_turns
from armlink.drives.orders import Limits, Mode, ReadingRange
from armlink.errors import BusFault, Refused

QUICK_STOP_AND_HOLD = 6
"""605Ah: quick stop ramp, then stay in quick stop, power on: the joint holds."""
MAX_PROFILE_VELOCITY = Entry(0x607F, 0, "I", "max profile velocity")
MAX_MOTOR_SPEED = Entry(0x6080, 0, "I", "max motor speed")
"""Bounds that a device may have besides the objects that the link uses: no data sheet needs them."""
COARSER_UNIT = "choose a coarser unit in the device"
SPEED_ROUNDING = 1e-3
"""A speed in whole counts is as exact as this."""
DISPLAY_READS = 5
"""A mode that was written is displayed within this many reads."""
ABORT_IS_QUICK_STOP = 3
"""6007h: what a lost host leads to."""


@dataclass(frozen=True)
class Protection:
    """Supervision by the controller itself."""

    host: int
    """Node id of the host, whose heartbeat the joints watch."""
    deadline: float
    """`link.deadline` [s]."""

    @property
    def deadline_ms(self) -> int:
        """A joint that hears no RPDO1 for this long goes to quick stop."""
        return milliseconds(self.deadline)

    @property
    def heartbeat_ms(self) -> int:
        """A joint that hears no heartbeat of the host for this long goes to quick stop."""
        return milliseconds(2 * self.deadline)

    @property
    def producer_ms(self) -> int:
        return milliseconds(self.deadline / 2)


@dataclass(frozen=True)
class Identity:
    """One node as `scan` finds it."""

    joint: str
    """Joint name of the arm file; empty for a node that the arm file does not know."""
    node: int
    present: bool
    name: str = ""
    device_type: int = 0
    vendor: int = 0
    product: int = 0
    revision: int = 0
    serial: int = 0
    state: DriveState = DriveState.UNKNOWN
    answers: int = 1
    """How many answered one request at this node id; more than one is a duplicated id."""
    lost: tuple[str, ...] = ()
    """Objects that a stock device of the arm file lacks, each with what is lost by it."""


def milliseconds(seconds: float) -> int:
    """Whole milliseconds, at least one."""
    return max(1, math.ceil(seconds * 1e3 - 1e-9))


def protection_of(section: LinkSection, nodes: Collection[int]) -> Protection:
    """With the highest node id that no joint has for the host."""
    return Protection(next(node for node in range(127, 0, -1) if node not in nodes), section.deadline)


def identify(services: NodeServices) -> Identity:
    """Identity (1000h, 1008h, 1018h) and CiA 402 state of a node that is there."""
    read = services.read
    return Identity(
        joint=services.joint,
        node=services.node,
        present=True,
        name=services.read_text(objects.DEVICE_NAME_INDEX),
        device_type=int(read(objects.DEVICE_TYPE)),
        vendor=int(read(objects.VENDOR)),
        product=int(read(objects.PRODUCT)),
        revision=int(read(objects.REVISION)),
        serial=int(read(objects.SERIAL)),
        state=state_of(int(read(objects.STATUS_WORD))),
    )


def serial_number(services: NodeServices) -> str:
    """Vendor, product and serial number (1018h) in hex; empty for a device without a serial number of its own."""
    if not services.has(objects.SERIAL):
        return ""
    vendor, product, serial = (int(services.read(entry)) for entry in (objects.VENDOR, objects.PRODUCT, objects.SERIAL))
    return f"{vendor:x}:{product:x}:{serial:x}" if serial else ""


IDENTITY_OBJECTS = {
    "vendor": objects.VENDOR,
    "product": objects.PRODUCT,
    "revision": objects.REVISION,
    "serial": objects.SERIAL,
}


def identity_mismatches(stated: DeviceIdentity, found: Mapping[str, int]) -> list[str]:
    """Differences between an identity (1018h: vendor, product, revision, serial) and the arm file, in words."""
    mismatches = []
    for key, entry in IDENTITY_OBJECTS.items():
        expected = getattr(stated, key)
        if expected is not None and found[key] != expected:
            mismatches.append(f"{entry} is {found[key]:#x}, expected {expected:#x}")
    return mismatches


def check_identity(services: NodeServices, joint: LinkJoint) -> None:
    """Raise Refused where another controller answers at the joint's node than arm file and data sheet state."""
    expected = expected_identity(joint, services.remote.object_dictionary)
    stated = [key for key in IDENTITY_OBJECTS if getattr(expected, key) is not None]
    found = {key: int(services.read(IDENTITY_OBJECTS[key])) for key in stated}
    mismatches = identity_mismatches(expected, found)
    if mismatches:
        raise refused_identity(joint.name, joint.settings.node, mismatches)


def refused_identity(name: str, node: int, mismatches: list[str]) -> Refused:
    """The refusal of a joint's controller, with what differs and how to fix it."""
    return Refused(
        f"{name} (node {node}): not the drive in the arm file: {'; '.join(mismatches)}: connect the "
        "right arm, or correct `identity` or `eds` of this joint under link.joints"
    )


def check_modes(services: NodeServices) -> int:
    """Supported modes (6502h); raises BusFault where cyclic synchronous position or torque mode is not among them."""
    supported = int(services.read(objects.SUPPORTED_MODES))
    for mode in NEEDED_MODES:
        if not supports(supported, mode):
            raise BusFault(
                f"{services.joint} (node {services.node}): mode {int(mode)} ({MODE_NAMES[mode]}) "
                f"is not supported: 6502h is {supported:#x}"
            )
    return supported


def offered_modes(services: NodeServices) -> int:
    """Modes of a stock device as bits of 6502h, each of those that the link uses tried: a mode's own display is
    believed, 6502h where there is none. The device is left in a position mode, or where it has none in cyclic velocity.
    Raises BusFault without either."""
    told = int(services.read(objects.SUPPORTED_MODES)) if services.has(objects.SUPPORTED_MODES) else 0
    offered = 0
    for mode in (Mode.PROFILE_TORQUE, Mode.TORQUE, Mode.PROFILE_POSITION, Mode.POSITION):
        needed = objects.TARGET_TORQUE if mode in (Mode.TORQUE, Mode.PROFILE_TORQUE) else objects.TARGET_POSITION
        if services.has(needed) and _enters(services, mode, supports(told, mode)):
            offered |= 1 << (mode - 1)
    if supports(offered, Mode.POSITION) or supports(offered, Mode.PROFILE_POSITION):
        return offered
    if services.has(objects.TARGET_VELOCITY) and _enters(services, CYCLIC_VELOCITY, supports(told, CYCLIC_VELOCITY)):
        return offered | 1 << (CYCLIC_VELOCITY - 1)
    raise BusFault(
        f"{services.joint} (node {services.node}): the drive accepts none of the modes 8, 1 (position) and "
        f"9 (velocity): 6502h is {told:#x}"
    )


def examine_device(services: NodeServices, settings: CanopenSettings) -> Profile:
    """The profile of a device, by asking for each object and trying the modes; raises BusFault."""
    profile = examine_objects(services, settings)
    if profile is OURS:
        return profile
    offered = offered_modes(services)
    profile_alone = supports(offered, Mode.PROFILE_TORQUE) and not supports(offered, Mode.TORQUE)
    leading = (Mode.POSITION, Mode.PROFILE_POSITION, CYCLIC_VELOCITY)
    return replace(
        profile,
        position_mode=next(int(mode) for mode in leading if supports(offered, mode)),
        torque_mode=int(Mode.PROFILE_TORQUE if profile_alone else Mode.TORQUE),
    )


def _enters(services: NodeServices, mode: int, told: bool) -> bool:
    try:
        services.write(objects.MODE, int(mode))
    except BusFault:
        return False
    if not services.has(objects.MODE_DISPLAY):
        return told
    return any(int(services.read(objects.MODE_DISPLAY)) == mode for _ in range(DISPLAY_READS))


def configure_pdo(services: NodeServices, each: Pdo, deadline_ms: int, profile: Profile = OURS) -> None:
    """Map one PDO of the link and read the mapping back; raises BusFault naming the joint.

    RPDO1 gets the deadline [ms], where the device has one: a joint that hears none for this long stops by itself.
    """
    is_command, stock = each.communication == pdo.RPDO1.communication, profile is not OURS
    deadline = deadline_ms if is_command and profile.has(objects.RPDO_DEADLINE) else None if stock else 0
    pdo.configure(services, each, deadline)


def configure(
    services: NodeServices,
    joint: LinkJoint,
    unit: Units,
    limits: Limits,
    protection: Protection,
    supported: int,
    profile: Profile = OURS,
) -> None:
    """PDOs, the link's and no others, and limits that hold even without this host: torque, window, quick stop, watch.

    All is read back. The torque offset 60B2h, which adds to every target torque and stays latched, is cleared where the
    device has one. `supported` is 6502h. Raises BusFault naming joint and object.
    """
    pdo.disable_others(services)
    for each in profile.pdos:
        configure_pdo(services, each, protection.deadline_ms, profile)
    if services.has(objects.TORQUE_OFFSET):
        services.write_checked(objects.TORQUE_OFFSET, 0)
    for entry, value in settings(unit, limits, protection, supported, profile):
        services.write_checked(entry, value)


def settings(
    unit: Units, limits: Limits, protection: Protection, supported: int, profile: Profile = OURS
) -> list[tuple[Entry, int]]:
    """Settings of one controller besides its PDOs, in this order.

    Profile modes, where the device has them (6502h, `supported`), get the arm file's velocity and torque rate. What a
    device lacks is left out.
    """
    value, exponent = interpolation(limits.period)
    held = [
        (objects.MAX_TORQUE, math.floor(limits.max_torque / unit.torque + 1e-9)),
        (objects.POSITION_LOWER, math.ceil(limits.lower / unit.position)),
        (objects.POSITION_UPPER, math.floor(limits.upper / unit.position)),
        (objects.QUICK_STOP_OPTION, QUICK_STOP_AND_HOLD),
        (objects.ABORT_OPTION, ABORT_IS_QUICK_STOP),
        (objects.INTERPOLATION_VALUE, value),
        (objects.INTERPOLATION_INDEX, exponent),
        (objects.HEARTBEAT_PRODUCER, protection.producer_ms),
        (objects.HEARTBEAT_CONSUMER, protection.host << 16 | protection.heartbeat_ms),
    ]
    if supports(supported, Mode.PROFILE_POSITION):
        held.append((objects.PROFILE_VELOCITY, max(1, math.floor(limits.max_velocity / unit.velocity))))
    if supports(supported, Mode.PROFILE_TORQUE):
        held.append((objects.TORQUE_SLOPE, max(1, math.floor(limits.torque_rate / unit.torque))))
    return [(entry, value) for entry, value in held if profile.has(entry)]


def interpolation(period: float) -> tuple[int, int]:
    """Interpolation time 60C2h of a cycle of `period` seconds: value and power of ten, as exact as a byte allows."""
    for exponent in (-3, -4, -5):
        value = round(period / 10.0**exponent)
        if 1 <= value <= 255 and math.isclose(value * 10.0**exponent, period, rel_tol=1e-9):
            return value, exponent
    exponent = math.ceil(math.log10(period / 255))
    return round(period / 10.0**exponent), exponent


def reading_ranges(
    services: NodeServices, joint: LinkJoint, unit: Units, limits: Limits, profile: Profile
) -> tuple[ReadingRange, ...]:
    """Ends of a device's readings by the sizes of its objects. Raises Refused where the device itself turns no faster
    than the arm file asks for: 607Fh, in units of 606Ch, and 6080h, in motor revolutions a minute."""
    stated, (motor, shaft) = limits.max_velocity, gear_turns(services)
    for entry, fastest in (
        (MAX_PROFILE_VELOCITY, unit.velocity),
        (MAX_MOTOR_SPEED, 2 * math.pi / 60 * (shaft / motor)),
    ):
        count = int(services.read(entry)) if services.has(entry) else 0
        if 0 < count * fastest < stated * (1 - SPEED_ROUNDING):
            raise Refused(
                f"{joint.name} ({joint.settings.address}): {entry} is {count}, which is "
                f"{count * fastest:.4g} rad/s, but max_velocity is {stated:.4g} rad/s: set the object to "
                f"{math.ceil(stated / fastest)} or more, or lower max_velocity"
            )
    ranges = [ReadingRange("position", 2**31 * unit.position, str(objects.POSITION), COARSER_UNIT)]
    if profile.has(objects.VELOCITY):
        ranges.append(ReadingRange("velocity", 2**31 * unit.velocity, str(objects.VELOCITY), COARSER_UNIT))
    if profile.has(objects.MOTOR_TORQUE):
        ranges.append(ReadingRange("torque", (2**15 - 1) * unit.torque, str(objects.MOTOR_TORQUE), COARSER_UNIT))
    return tuple(ranges)


def read_temperature(services: NodeServices) -> float:
    """Temperature of a drive [°C], NaN if its data sheet or the device has none.

    CiA 402 has no object for it, so it is read if the data sheet has one at 2101h (INTEGER16, 0.1 °C).
    """
    told = services.remote.object_dictionary.get_variable(objects.TEMPERATURE.index, objects.TEMPERATURE.sub)
    if told is None or "temperature" not in told.name.lower() or not services.has(objects.TEMPERATURE):
        return math.nan
    return float(services.read(objects.TEMPERATURE)) / 10
