"""The joints' CiA 402 devices: their power-on values, and how stock devices differ by their data sheets.

Sources: the makers' data sheets (EDS) and firmware specifications, in own words; docs/drives.md names them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.canopen.eds_file import expected_identity, of_joints
from armlink.drives.canopen.settings import TorqueObject
from armlink.drives.canopen.units import USER_UNITS
from sim_bus.node.object_arrays import INPUT, Key
from sim_bus.node.position_torque_loops import CSP, CST, CSV, PROFILE_POSITION, PROFILE_TORQUE, UNIT
from sim_bus.sim_section import serial_of, sim_section

SUPPORTED_MODES = sum(1 << (mode - 1) for mode in (PROFILE_POSITION, PROFILE_TORQUE, CSP, CSV, CST))
"""Supported drive modes (6502h)."""
IDENTITY = ("vendor", "product", "revision", "serial")
"""Keys of a joint's identity in the arm file, in the order of 1018h's sub-indices."""
TEMPERATURE = 310
"""Temperature of every drive [0.1 °C]."""
OURS = "ours"
_ABSENT_IN_ALL = frozenset({0x2101})


@dataclass(frozen=True)
class Device:
    absent: frozenset[int | Key] = frozenset()
    """Objects, whole or by sub-index, that it lacks."""
    values: Mapping[Key, int | str] = field(default_factory=dict)
    """Objects whose value differs from ours."""
    unmappable: frozenset[Key] = frozenset()
    """Objects that cannot be mapped into a PDO."""
    wide_2100: bool = False
    """Whether 2100h:01 is a 64-bit serial number."""
    fixed_exponent: bool = False
    """Whether 60C2h:02 takes −3 only."""
    rpm: bool = False
    """Whether 606Ch is in revolutions a minute of the motor instead of user units a second."""
    modes: frozenset[int] | None = None
    """Modes that it has; None: all of ours."""
    hidden_modes: int = 0
    """Bits that 6502h does not show although the device has the modes."""


DEVICES: dict[str, Device] = {
    OURS: Device(),
    "cia402": Device(absent=frozenset({0x2100, (0x1010, 4), 0x60B2})),
    "epos4": Device(
        absent=frozenset({(0x1010, 4), (0x1400, 5), 0x6072, 0x6087, 0x608F, 0x6091, 0x6092}),
        values={(0x60A8, 0): 0x00B50000, (0x60A9, 0): 0x00B44700, (0x1008, 0): "EPOS4"},
        wide_2100=True,
        rpm=True,
        hidden_modes=1 << 7,
    ),
    "nanotec": Device(absent=frozenset({0x2100, (0x1010, 4), 0x6076, 0x60B2, (0x1400, 5)}), fixed_exponent=True),
    "copley": Device(absent=frozenset({0x2100, (0x1010, 4), (0x1400, 5), 0x60B2}), values={(0x6076, 0): 0}),
    "profile": Device(
        absent=frozenset({0x2100, (0x1010, 4), 0x60B2, (0x1400, 5)}), modes=frozenset({1, 4}), hidden_modes=1 << 3
    ),
    "velocity": Device(
        absent=frozenset({0x2100, (0x1010, 4), 0x60B2, (0x1400, 5), 0x6071, 0x607A, 0x607D, 0x6081, 0x6087}),
        modes=frozenset({9}),
    ),
    "sample": Device(
        absent=frozenset({0x2100, (0x1010, 4), 0x1016, 0x60B2, (0x1400, 5)}),
        unmappable=frozenset({(0x6060, 0), (0x6061, 0)}),
    ),
}
"""`ours` has our torque sensor record, `cia402` all of the profile; `profile` has the profile modes alone; `velocity`
has cyclic velocity alone, as drives of axes whose controller closes the position loop; the others are as their makers'
data sheets."""


def device_of(joint: LinkJoint, named: str | None) -> Device:
    """The device of a joint: named in the `sim` section, else by what the arm file reads torque from."""
    settings = joint.settings
    if settings.family != "canopen":
        return DEVICES[OURS]
    kind = named or (OURS if settings.torque == "record" else "cia402")
    device = DEVICES[kind]
    if kind == OURS:
        return Device(absent=frozenset({INPUT}))
    absent = device.absent | _ABSENT_IN_ALL
    if not (isinstance(settings.torque, TorqueObject) and settings.torque.index == INPUT):
        absent |= {INPUT}
    return Device(**{**vars(device), "absent": absent})


def power_on_values(arm: ArmFile, joint: LinkJoint, increments: int, device: Device) -> dict[Key, int | str]:
    """Objects of one joint that differ from the EDS's defaults; `increments` of the encoder per joint revolution."""
    link, servo = arm.require_link(), sim_section(arm).servo
    stated = expected_identity(joint, of_joints(arm, [joint])[0]).model_dump(exclude_none=True)
    modes = SUPPORTED_MODES if device.modes is None else sum(1 << (mode - 1) for mode in device.modes)
    deceleration = round(servo.quick_stop_deceleration / UNIT)
    return {
        (0x1018, 4): serial_of(arm, joint),
        (0x2101, 0): TEMPERATURE,
        (0x6072, 0): min(round(joint.max_torque * 1000 / joint.rated_torque), 0xFFFF),
        (0x6076, 0): round(joint.rated_torque * 1000),
        (0x6081, 0): round(joint.max_velocity / UNIT),
        (0x6083, 0): deceleration,
        (0x6085, 0): deceleration,
        (0x6087, 0): round(joint.max_torque_rate * 1000 / joint.rated_torque),
        (0x608F, 1): increments,
        (0x6092, 1): USER_UNITS,
        (0x60C2, 1): min(max(round(1000 / link.rate), 1), 255),
        (0x6502, 0): modes & ~device.hidden_modes,
        **device.values,
        **{(0x1018, sub): stated[key] for sub, key in enumerate(IDENTITY, start=1) if key in stated},
    }
