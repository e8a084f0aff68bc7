"""What a cycle takes of each bus, before a frame has left. Pure."""

from collections.abc import Iterator
from dataclasses import dataclass

from armlink.arm_file import ArmFile
from armlink.drives.registry import family

HIGH_LOAD = 0.8
"""Share of the bit rate above which frames come late; a choice."""


@dataclass(frozen=True)
class BusLoad:
    """Of one bus, with every stuff bit that its frames may need."""

    joints: int
    rate: float
    """Cycles a second [Hz]."""
    bitrate: int
    """[bit/s]."""
    share: float
    """Of the bit rate, at most."""

    @property
    def what(self) -> str:
        """In words."""
        return (
            f"{self.joints} joints at {self.rate:g} Hz load the bus by up to {self.share:.0%} of {self.bitrate} bit/s"
        )

    @property
    def remedy(self) -> str:
        """How to come down to HIGH_LOAD."""
        return f"lower link.rate to {int(self.rate * HIGH_LOAD / self.share)} Hz, or spread the joints over link.buses"


def bus_loads(arm: ArmFile) -> Iterator[BusLoad]:
    """Of each bus of an arm file."""
    link = arm.require_link()
    for bus in dict.fromkeys(joint.bus for joint in link.joints):
        joints = [joint for joint in link.joints if joint.bus == bus]
        bits = 0.0
        for name in dict.fromkeys(joint.settings.family for joint in joints):
            own = [joint for joint in joints if joint.settings.family == name]
            bits += family(name).build(arm, own).cycle_bits()
        bitrate = link.buses[bus].bitrate if bus else link.bus.bitrate
        yield BusLoad(len(joints), link.rate, bitrate, link.rate * bits / bitrate)
