"""Findings about this machine's bus and the drives on it, which are only read."""

from collections.abc import Iterator
from pathlib import Path

from armlink.arm_file import SIMULATED, ArmFile, Bus, LinkJoint
from armlink.bus.can_bus import CanBus
from armlink.bus.open import open_link_bus, resolve_bus
from armlink.drives.registry import family
from armlink.errors import ArmlinkError
from armlink.link.joints.groups import make_groups
from armlink.link.link import Link
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
        remedy = (
            f"check its name, its driver and that it is up; without it: armlink doctor {arm_file.argument} --offline"
        )
        yield SetupFinding("error", reason or what, name, remedy)
        return
    try:
        yield from _drives(arm_file, opened, name)
    except ArmlinkError as error:
        yield SetupFinding(
            "error",
            str(error),
            name,
            f"check power, wiring and bit rate; more is shown by armlink scan {arm_file.argument}",
        )
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
        load = link.rate * _cycle_bits(arm_file, [joint for joint in link.joints if joint.bus == bus]) / rate
        if load > HIGH_LOAD:
            what = f"{count} joints at {link.rate:g} Hz load the bus by up to {load:.0%} of {rate} bit/s"
            remedy = f"lower link.rate to {int(link.rate * HIGH_LOAD / load)} Hz, or spread the joints over link.buses"
            yield SetupFinding("error" if load > 1 else "warning", what, f"{arm_file.path}: link.rate", remedy)


def _cycle_bits(arm_file: ArmFile, joints: list[LinkJoint]) -> float:
    """Bit times that a cycle of the joints of one bus takes at most."""
    found = 0.0
    for name in dict.fromkeys(joint.settings.family for joint in joints):
        found += family(name).build(arm_file, [each for each in joints if each.settings.family == name]).cycle_bits()
    return found


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


def another_drive(mismatch: str, where: str) -> SetupFinding:
    """A drive that is not the one of the arm file."""
    return SetupFinding("error", mismatch, where, "connect the right arm, or correct its drive under link.joints")


def _drives(arm_file: ArmFile, opened: CanBus, bus: str) -> Iterator[SetupFinding]:
    """What the drives on the open bus say against the arm file."""
    groups = make_groups(arm_file, opened)
    kind = groups[0].family
    if len(groups) == 1 and kind.examine is not None:
        for finding in kind.examine(arm_file, opened, bus):
            yield SetupFinding(finding.level, finding.what, finding.where, finding.remedy)
        return
    link = Link(arm_file, opened)
    for each in link.scan():
        where = f"{link.names[each.joint]} ({each.address})"
        if not each.present:
            yield SetupFinding("error", f"no answer on {bus}", where, "check its power, wiring and id")
        elif each.mismatch:
            yield another_drive(each.mismatch, where)
