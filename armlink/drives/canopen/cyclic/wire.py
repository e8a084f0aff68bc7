"""One CiA 402 joint on the wire: the objects that its PDOs carry, their scales, and its limits."""

import struct
from dataclasses import dataclass
from functools import cached_property

from armlink.arm_file import LinkJoint
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import RPDO1
from armlink.drives.canopen.profile import Profile
from armlink.drives.canopen.units import TORQUE_PER_MICRO, Units
from armlink.drives.orders import Limits
from armlink.errors import BadInput

INT16_MAX, INT32_MAX, UINT32_MAX = 2**15 - 1, 2**31 - 1, 2**32 - 1
NO_LIMITS = Limits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of a joint that is only listened to."""


@dataclass(frozen=True)
class Wire:
    """A joint's part of the bus."""

    node: int
    profile: Profile
    unit: Units
    limits: Limits = NO_LIMITS

    @cached_property
    def entries(self) -> dict[str, tuple[Entry, ...]]:
        """Objects of each PDO, by its name; a PDO that is not used is absent."""
        return {each.name: each.entries for each in self.profile.pdos}

    @cached_property
    def layouts(self) -> dict[str, struct.Struct]:
        return {each.name: each.layout for each in self.profile.pdos}

    @cached_property
    def with_torque(self) -> bool:
        return objects.TARGET_TORQUE in self.entries[RPDO1.name]

    @cached_property
    def by_velocity(self) -> bool:
        """Whether target velocities take the place of target positions (mode 9)."""
        return self.profile.by_velocity


def check_fits(row: LinkJoint, limits: Limits, unit: Units) -> None:
    """Raise BadInput where limits fit no frame and no object, our torque record 2100h included."""
    name = row.name
    if row.settings.torque == "record" and limits.max_torque / TORQUE_PER_MICRO > INT32_MAX:
        most = INT32_MAX * TORQUE_PER_MICRO
        raise BadInput(
            f"{name}: max_torque is {limits.max_torque} N·m, but object 2100h can report at most "
            f"{most:.4g} N·m: lower max_torque, or take a drive that reports larger torques"
        )
    for key, value, of, scale, most, place in (
        ("max_torque", limits.max_torque, "N·m", unit.torque, INT16_MAX, "6071h"),
        ("max_velocity", limits.max_velocity, "rad/s", unit.velocity, UINT32_MAX, "6081h"),
        ("max_torque_rate", limits.torque_rate, "N·m/s", unit.torque, UINT32_MAX, "6087h"),
    ):
        if value / scale > most:
            raise BadInput(f"{name}: {key} is {value} {of}, but {place} carries at most {most * scale:.6g} {of}")
    if max(abs(limits.lower), abs(limits.upper)) / unit.position > INT32_MAX:
        raise BadInput(
            f"{name}: 607Ah cannot carry the range of this joint, since one user unit is only {unit.position:.3g} rad"
        )
