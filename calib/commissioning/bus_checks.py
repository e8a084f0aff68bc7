"""Findings about this machine's bus and the drives on it, which are only read."""

from collections.abc import Iterator
from pathlib import Path

from armlink.arm_file import SIMULATED, ArmFile, Bus
from armlink.bus.frame_bits import longest_frame_bits
from armlink.bus.open import open_link_bus, resolve_bus
from armlink.drives.canopen import pdo
from armlink.drives.canopen.eds_file import expected_identity, of_joints
from armlink.errors import ArmlinkError
from armlink.link.controller_setup import RATED_TORQUE_TOLERANCE, identity_mismatches
from armlink.monitor.drives import Drives, FoundDrive
from calib.commissioning.finding import SetupFinding

INTERFACES = Path("/sys/class/net")
"""Where Linux lists its network interfaces."""
HIGH_LOAD = 0.8
"""Share of the bit rate above which frames come late; a choice."""


def bus_findings(arm_file: ArmFile, spec: str | None = None) -> Iterator[SetupFinding]:
    """Findings about the bus and the drives; `spec` replaces the arm file's bus."""
    link = arm_file.require_link()
    yield from _load(arm_file)
    bus = link.bus if spec is None else resolve_bus(spec, link.bus)
    name = f"{bus.interface}:{bus.channel}"
    absent = _absent_interface(bus) if not link.buses or spec is not None else None
    if absent is not None:
        yield absent
        return
    try:
        opened = open_link_bus(spec, link)
    except ArmlinkError as error:
        what, _, reason = str(error).partition(": ")
        remedy = "check its name, its driver and that it is up; armlink doctor --offline leaves it out"
        yield SetupFinding("error", reason or what, name, remedy)
        return
    try:
        yield from _drives(arm_file, Drives(opened).found, name)
    except ArmlinkError as error:
        yield SetupFinding("error", str(error), name, "check power, wiring and bit rate; armlink scan shows more")
    finally:
        opened.shutdown()
    if bus.interface == SIMULATED:
        real = "set link.bus for the real arm, such as {interface: socketcan, channel: can0}"
        yield SetupFinding("hint", "the bus is a simulated arm in this process", f"{arm_file.path}: link.bus", real)


def _load(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Whether the cycle's frames fit the bit rate."""
    link = arm_file.require_link()
    for bus in dict.fromkeys(joint.bus for joint in link.joints):
        count = sum(joint.bus == bus for joint in link.joints)
        rate = link.buses[bus].bitrate if bus else link.bus.bitrate
        each = [longest_frame_bits(frame.layout.size) for frame in (pdo.RPDO1, pdo.TPDO1)]
        slow = longest_frame_bits(pdo.TPDO2.layout.size) / pdo.STATUS_DECIMATION
        load = link.rate * (count * (sum(each) + slow) + longest_frame_bits(0)) / rate
        if load > HIGH_LOAD:
            what = f"{count} joints at {link.rate:g} Hz load the bus by up to {load:.0%} of {rate} bit/s"
            remedy = f"lower link.rate to {int(link.rate * HIGH_LOAD / load)} Hz, or spread the joints over link.buses"
            yield SetupFinding("error" if load > 1 else "warning", what, f"{arm_file.path}: link.rate", remedy)


def _absent_interface(bus: Bus) -> SetupFinding | None:
    """A SocketCAN interface that is not there, or down, with the command that brings it up."""
    if bus.interface != "socketcan" or not INTERFACES.is_dir():
        return None
    folder, name = INTERFACES / bus.channel, f"{bus.interface}:{bus.channel}"
    if not folder.is_dir():
        there = [each.name for each in INTERFACES.iterdir() if "can" in each.name]
        known = f"there are {', '.join(sorted(there))}" if there else "this machine has no CAN interface"
        make = f"sudo ip link add {bus.channel} type vcan" if bus.channel.startswith("vcan") else "connect the adapter"
        return SetupFinding("error", f"no interface {bus.channel}: {known}", name, make)
    if int((folder / "flags").read_text(), 16) & 1:
        return None
    set_up = "" if bus.channel.startswith("vcan") else f" type can bitrate {bus.bitrate} restart-ms 100"
    return SetupFinding("error", "the interface is down", name, f"sudo ip link set {bus.channel} up{set_up}")


def _drives(arm_file: ArmFile, found: list[FoundDrive], bus: str) -> Iterator[SetupFinding]:
    link, by_node = arm_file.require_link(), {each.node: each for each in found}
    spare = [each.node for each in found if each.node not in {joint.node for joint in link.joints}]
    unknown = f"; nodes {', '.join(map(str, spare))} answer and are in no joint" if spare else ""
    for joint, sheet in zip(link.joints, of_joints(arm_file), strict=True):
        where = f"{joint.name} (node {joint.node})"
        drive = by_node.get(joint.node) if joint.node is not None else None
        if drive is None:
            remedy = f"check its power, wiring and node id{unknown}; armlink new with --bus finds the drives"
            yield SetupFinding("error", f"no answer on {bus}", where, remedy)
            continue
        for differs in identity_mismatches(expected_identity(joint, sheet), vars(drive.identity)):
            remedy = "connect the right arm, or correct identity under link.joints"
            yield SetupFinding("error", f"another controller: {differs}", where, remedy)
        if abs(drive.rated_torque - joint.rated_torque) > RATED_TORQUE_TOLERANCE * joint.rated_torque:
            what = f"its rated torque (6076h) is {drive.rated_torque:g} N·m, the arm file has {joint.rated_torque:g}"
            yield SetupFinding(
                "error", what, where, f"set rated_torque: {drive.rated_torque:g}, or connect its own drive"
            )
        if drive.max_torque < joint.max_torque * (1 - RATED_TORQUE_TOLERANCE):
            what = f"the drive allows {drive.max_torque:g} N·m (6072h), max_torque is {joint.max_torque:g}"
            yield SetupFinding("warning", what, where, f"lower max_torque to {drive.max_torque:g}, or raise 6072h")
    if spare and len(found) - len(spare) == len(link.joints):
        what = f"nodes {', '.join(map(str, spare))} answer and belong to no joint"
        yield SetupFinding("hint", what, bus, "a gripper or another arm: nothing is sent to them")
