"""The simulated drives of an arm that are no CANopen nodes, by family and bus."""

from collections.abc import Callable, Sequence

from armlink.arm_file import ArmFile, LinkJoint
from armlink.contributed import contributions
from armlink.errors import BadInput
from sim_bus.drives.cubemars import CubeMarsDrive
from sim_bus.drives.damiao import DamiaoDrive
from sim_bus.drives.moteus import MoteusDrive
from sim_bus.drives.motor import Motor
from sim_bus.drives.myactuator import MyActuatorDrive
from sim_bus.drives.odrive import ODriveAxis
from sim_bus.drives.piper import build as build_piper
from sim_bus.drives.robstride import RobStrideDrive
from sim_bus.drives.simulated_drive import Front, SimulatedDrive

Send = Callable[[int, bytes], None]
Joint = tuple[LinkJoint, Motor]
Build = Callable[[ArmFile, Sequence[Joint], Send], Front]


def _each(drive: Callable[[ArmFile, LinkJoint, Motor, Send], SimulatedDrive]) -> Build:
    return lambda arm, joints, send: Front([drive(arm, joint, motor, send) for joint, motor in joints])


FAMILIES: dict[str, Build] = {
    "cubemars": _each(CubeMarsDrive),
    "damiao": _each(DamiaoDrive),
    "robstride": _each(RobStrideDrive),
    "moteus": _each(MoteusDrive),
    "odrive": _each(ODriveAxis),
    "myactuator": _each(MyActuatorDrive),
    "piper": build_piper,
}
GROUP = "armlink.simulated_drives"
"""Entry-point group of functions like those of FAMILIES, for families of other packages."""


def simulated_families() -> dict[str, Build]:
    return FAMILIES | {point.name: point.load() for point in contributions(GROUP)}


def build_fronts(arm: ArmFile, motors: Sequence[Motor], send: Callable[[str], Send]) -> list[tuple[str, Front]]:
    """Bus name and front of every family on every bus; `motors` of all joints in arm order, `send(bus)` puts frames.

    Raises BadInput for a family that is not simulated.
    """
    known, groups = simulated_families(), dict[tuple[str, str], list[Joint]]()
    for joint, motor in zip(arm.require_link().joints, motors, strict=True):
        family = joint.settings.family
        if family == "canopen":
            continue
        if family not in known:
            raise BadInput(
                f"{arm.path}: {joint.name}: drives of family {family!r} cannot be simulated; the simulated "
                f"families are canopen, {', '.join(known)}"
            )
        groups.setdefault((joint.bus, family), []).append((joint, motor))
    return [(bus, known[family](arm, joints, send(bus))) for (bus, family), joints in groups.items()]
