"""Share of each bus that a cycle takes, before a frame has left. Pure."""

from collections.abc import Iterator
from dataclasses import dataclass

from armlink.arm_file import SIMULATED, ArmFile, Bus, LinkJoint, LinkSection
from armlink.bus.open import is_virtual, resolve_bus
from armlink.drives.family import family

HIGH_LOAD = 0.8
"""Share of the bit rate above which frames come late; a choice."""


@dataclass(frozen=True)
class BusLoad:
    """Of one bus, with every stuff bit that its frames may need."""

    bus: Bus
    joints: int
    rate: float
    """Cycles a second [Hz]."""
    share: float
    """Of the bit rate, at most."""

    @property
    def what(self) -> str:
        joints, load = ("1 joint", "loads") if self.joints == 1 else (f"{self.joints} joints", "load")
        return f"{joints} at {self.rate:g} Hz {load} the bus by up to {self.share:.0%} of {self.bus.bitrate} bit/s"

    @property
    def remedy(self) -> str:
        """How to come down to HIGH_LOAD."""
        return f"lower link.rate to {int(self.rate * HIGH_LOAD / self.share)} Hz, or spread the joints over link.buses"


def bus_loads(arm: ArmFile, spec: str | None = None) -> Iterator[BusLoad]:
    """Of each bus of an arm file, or of the one named by `spec`, as open_link_bus takes it."""
    link = arm.require_link()
    for bus, joints in _buses(link, spec):
        bits = 0.0
        for name in dict.fromkeys(joint.settings.family for joint in joints):
            own = [joint for joint in joints if joint.settings.family == name]
            bits += family(name).build(arm, own).cycle_bits()
        yield BusLoad(bus, len(joints), link.rate, link.rate * bits / bus.bitrate)


def overload(arm: ArmFile, spec: str | None = None) -> str:
    """The first wire that cannot carry the cycle, and the remedy, in words; empty if there is none."""
    for load in bus_loads(arm, spec):
        if load.share > 1 and not is_virtual(load.bus) and load.bus.interface != SIMULATED:
            return f"{load.what}: {load.remedy}"
    return ""


def _buses(link: LinkSection, spec: str | None) -> Iterator[tuple[Bus, list[LinkJoint]]]:
    if spec is not None:
        yield resolve_bus(spec, link.bus), list(link.joints)
        return
    for name in dict.fromkeys(joint.bus for joint in link.joints):
        bus = link.buses[name] if name else link.bus
        yield bus, [joint for joint in link.joints if joint.bus == name]
