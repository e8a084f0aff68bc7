"""Findings about this machine's bus and the drives on it, which are only read."""

from collections.abc import Iterator
from pathlib import Path

from armlink.arm_file import SIMULATED, ArmFile, Bus
from armlink.bus.can_bus import CanBus
from armlink.bus.open import open_link_bus, resolve_bus
from armlink.drives.findings import Level, SetupFinding
from armlink.errors import ArmlinkError
from armlink.link.bus_load import HIGH_LOAD, bus_loads
from armlink.link.gate_limits import joint_ranges
from armlink.link.joints.groups import make_groups, traits_of
from armlink.link.joints.values import values_of
from armlink.link.joints.whole_turns import WholeTurns
from armlink.link.link import Link

INTERFACES = Path("/sys/class/net")
"""Where Linux lists its network interfaces."""


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
            "check the name and the driver of the interface, and that the interface is up; to check without "
            f"the bus: armlink doctor {arm_file.argument} --offline"
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
            f"check power, wiring and bit rate; `armlink scan {arm_file.argument}` shows more",
        )
    finally:
        opened.shutdown()
    if bus.interface == SIMULATED:
        real = "for the real arm, write its bus under link.bus, such as {interface: socketcan, channel: can0}"
        yield SetupFinding("hint", "the bus is a simulated arm in this process", f"{arm_file.path}: link.bus", real)


def _load(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Whether the cycle's frames fit the bit rate."""
    for load in bus_loads(arm_file):
        if load.share > HIGH_LOAD:
            level: Level = "error" if load.share > 1 else "warning"
            yield SetupFinding(level, load.what, f"{arm_file.path}: link.rate", load.remedy)


def turn_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Joints of which nothing shows that their drive has lost a whole turn."""
    link = arm_file.require_link()
    try:
        turns = WholeTurns(arm_file, values_of(arm_file, make_groups(arm_file)), joint_ranges(arm_file))
    except ArmlinkError:  # told, with its remedy, by who needs the stops or the drives
        return
    found = [f"{link.joints[joint].name} ({turn:.3g} rad)" for joint, turn in turns.unnoticed()]
    if found:
        yield SetupFinding(
            "hint",
            "after power-on, the drives of these joints may count one turn too many or too few, and the "
            f"reading may still lie between the stops: {', '.join(found)}",
            f"{arm_file.path}: link.joints",
            "armlink cannot detect this error: use an encoder that knows its turn, or check the reading of "
            "such a joint after each power-on, before it moves",
        )


def silence_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Joints that no command gives power, since nothing stops their drives when the host dies."""
    try:
        groups = make_groups(arm_file)
    except ArmlinkError:  # as above
        return
    joints = zip(arm_file.require_link().joints, traits_of(groups), strict=True)
    found = [joint.name for joint, traits in joints if traits.silence == "keeps on"]
    if found:
        yield SetupFinding(
            "warning",
            f"if the host dies, the drives of these joints keep on with their last command: {', '.join(found)}",
            f"{arm_file.path}: link.joints",
            "armlink reads them and gives them no power: state the time-out that is set in them, where they have one "
            "(docs/drive-families.md)",
        )


def _absent_interface(bus: Bus) -> SetupFinding | None:
    """A SocketCAN interface that is not there, or down, with the command that brings it up."""
    if bus.interface != "socketcan" or not INTERFACES.is_dir():
        return None
    folder, name = INTERFACES / bus.channel, f"{bus.interface}:{bus.channel}"
    if not folder.is_dir():
        there = [each.name for each in INTERFACES.iterdir() if "can" in each.name]
        known = f"there are {', '.join(sorted(there))}" if there else "this machine has no CAN interface"
        make = f"sudo ip link add {bus.channel} type vcan" if bus.channel.startswith("vcan") else "connect the adapter"
        return SetupFinding("error", f"there is no interface {bus.channel}: {known}", name, make)
    if int((folder / "flags").read_text(), 16) & 1:
        return None
    set_up = "" if bus.channel.startswith("vcan") else f" type can bitrate {bus.bitrate} restart-ms 100"
    return SetupFinding("error", "the interface is down", name, f"sudo ip link set {bus.channel} up{set_up}")


def another_drive(mismatch: str, where: str) -> SetupFinding:
    """A drive that is not the one of the arm file."""
    return SetupFinding(
        "error",
        mismatch,
        where,
        "connect the right arm, or correct the entry of this joint under link.joints of the arm file",
    )


def _drives(arm_file: ArmFile, opened: CanBus, bus: str) -> Iterator[SetupFinding]:
    """Differences of the drives on the open bus from the arm file."""
    groups = make_groups(arm_file, opened)
    kind = groups[0].family
    if len(groups) == 1 and kind.examine is not None:
        found = list(kind.examine(arm_file, opened, bus))
        yield from found
        if all(each.level != "error" for each in found):
            yield from _places(Link(arm_file, opened))
        return
    link = Link(arm_file, opened)
    good = True
    for each in link.scan():
        where = f"{link.names[each.joint]} ({each.address})"
        if not each.present:
            yield SetupFinding("error", f"no answer on {bus}", where, "check its power, wiring and id")
        elif each.mismatch:
            yield another_drive(each.mismatch, where)
        good = good and each.present and not each.mismatch
    if good:
        yield from _places(link)


def _places(link: Link) -> Iterator[SetupFinding]:
    """Joints that cannot stand where their drives read them."""
    positions = link.read_positions()
    before = link.turns.misplaced(positions)
    link.correct_turns()
    after = {each.joint for each in link.turns.misplaced(link.read_positions())}
    for each in before:
        where = f"{each.name} ({link.section.joints[each.joint].settings.address})"
        if each.joint in after:
            yield SetupFinding("error", each.what, where, each.remedy)
        else:
            yield SetupFinding(
                "hint", each.what, where, f"this is corrected at each start: {link.turns.note(each.joint)}"
            )
