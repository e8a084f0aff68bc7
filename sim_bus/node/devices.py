"""Stock CiA 402 devices as they are known from their data sheets: what they lack, and what they have differently.

Sources: the makers' data sheets (EDS) and firmware specifications, in own words; docs/drives.md names them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from armlink.arm_file import LinkJoint
from armlink.drives.canopen.settings import TorqueObject
from sim_bus.node.object_arrays import INPUT, Key

OURS = "ours"
_ABSENT_IN_ALL = frozenset({0x2101})


@dataclass(frozen=True)
class Device:
    """A kind of device."""

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
