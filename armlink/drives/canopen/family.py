"""CANopen drives with the CiA 402 profile."""

from collections.abc import Sequence

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.canopen.settings import CanopenSettings
from armlink.drives.family import Drives, Family
from armlink.drives.traits import Traits
from armlink.errors import BusFault


def build(arm: ArmFile, joints: Sequence[LinkJoint]) -> Drives:
    """Drives of these joints."""
    raise BusFault("the link still drives CANopen by its own cycle")


FAMILY = Family(
    name="canopen",
    traits=Traits(
        torque="link",
        calibration="controller",
        silence="holds",
        bounds=("torque", "window"),
        cadence="sync",
        frame="11",
    ),
    settings=CanopenSettings,
    build=build,
    summary="CiA 402 (CANopen), with or without our torque sensor object 2100h",
)
