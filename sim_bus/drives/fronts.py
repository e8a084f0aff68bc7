"""The simulated drives of an arm that are no CANopen nodes, by family and bus."""

from collections.abc import Callable, Sequence
from zlib import crc32

from armlink.arm_file import ArmFile, LinkJoint
from armlink.contributed import contributed
from armlink.drives.damiao.settings import MODELS
from armlink.errors import BadInput
from sim_bus.drives.cubemars import CubeMarsDrive, CubeMarsFront
from sim_bus.drives.damiao import DamiaoDrive, DamiaoFront
from sim_bus.drives.moteus import MoteusDrive, MoteusFront
from sim_bus.drives.motor import Motor
from sim_bus.drives.odrive import ODriveAxis, ODriveFront, cyclic_periods
from sim_bus.drives.robstride import RobStrideDrive, RobStrideFront
from sim_bus.drives.simulated_drive import Front

Send = Callable[[int, bytes], None]
Joint = tuple[LinkJoint, Motor]


def _damiao(arm: ArmFile, joints: Sequence[Joint], send: Send) -> Front:
    drives = []
    for joint, motor in joints:
        settings = joint.settings
        if settings.model not in MODELS:
            raise BadInput(
                f"{arm.path}: {joint.name}: drive.model is {settings.model!r}; simulated are {', '.join(MODELS)}"
            )
        drives.append(DamiaoDrive(motor, send, settings.id, settings.reply, settings.model, _serial(arm, joint)))
    return DamiaoFront(drives)


def _cubemars(arm: ArmFile, joints: Sequence[Joint], send: Send) -> Front:
    return CubeMarsFront([CubeMarsDrive(motor, send, each.settings) for each, motor in joints])


def _robstride(arm: ArmFile, joints: Sequence[Joint], send: Send) -> Front:
    return RobStrideFront(
        [
            RobStrideDrive(motor, send, each.settings.id, each.settings.model, _serial(arm, each))
            for each, motor in joints
        ]
    )


def _moteus(arm: ArmFile, joints: Sequence[Joint], send: Send) -> Front:
    return MoteusFront([MoteusDrive(motor, send, each.settings.id, _serial(arm, each)) for each, motor in joints])


def _odrive(arm: ArmFile, joints: Sequence[Joint], send: Send) -> Front:
    link = arm.require_link()
    periods = cyclic_periods(1.0 / link.rate)
    return ODriveFront(
        [
            ODriveAxis(motor, send, each.settings.node, _serial(arm, each), link.deadline, periods)
            for each, motor in joints
        ]
    )


FAMILIES: dict[str, Callable[[ArmFile, Sequence[Joint], Send], Front]] = {
    "cubemars": _cubemars,
    "damiao": _damiao,
    "robstride": _robstride,
    "moteus": _moteus,
    "odrive": _odrive,
}
"""Families that are simulated here, besides canopen."""
GROUP = "armlink.simulated_drives"
"""Entry-point group of functions like those of FAMILIES, for families of other packages."""


def simulated_families() -> dict[str, Callable[[ArmFile, Sequence[Joint], Send], Front]]:
    """Families that are simulated, by name."""
    return FAMILIES | {point.name: point.load() for point in contributed(GROUP)}


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
                f"{arm.path}: {joint.name}: drives of family {family!r} are not simulated; there are canopen, "
                f"{', '.join(known)}"
            )
        groups.setdefault((joint.bus, family), []).append((joint, motor))
    return [(bus, known[family](arm, joints, send(bus))) for (bus, family), joints in groups.items()]


def _serial(arm: ArmFile, joint: LinkJoint) -> int:
    return crc32(f"{arm.name} {arm.serial} {joint.name}".encode())
