"""Examines an arm file, its model, this machine and the bus; says what is missing or doubtful, first things first.

The drives on the bus are only read.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from armlink.arm_file import SIMULATED, ArmFile, BadKeys, Bus, bundled_arms, load_arm
from armlink.bus.can_bus import CanBus
from armlink.bus.open import is_listening, open_link_bus, resolve_bus
from armlink.drives.findings import Level, SetupFinding
from armlink.errors import ArmlinkError
from armlink.link.bus_load import HIGH_LOAD, bus_loads
from armlink.link.gate_limits import joint_ranges
from armlink.link.joints.groups import make_groups, traits_of
from armlink.link.joints.values import values_of
from armlink.link.joints.whole_turns import WholeTurns
from armlink.link.link import Link
from armlink.loop.open import is_in_process
from calib.commissioning.draft import assumed_lines
from calib.commissioning.model_checks import model_findings, motion_findings, sweep_errors
from gcomp.errors import GcompError

INTERFACES = Path("/sys/class/net")
"""Where Linux lists its network interfaces."""


def bus_findings(arm_file: ArmFile, spec: str | None = None) -> Iterator[SetupFinding]:
    """Findings about the bus and the drives; `spec` replaces the arm file's bus."""
    link = arm_file.require_link()
    yield from _load(arm_file)
    bus = link.bus if spec is None else resolve_bus(spec, link.bus)
    name = f"{bus.interface}:{bus.channel}"
    if is_listening(bus):
        look = f"see whether readings come: armlink monitor {arm_file.argument} --once"
        yield SetupFinding("hint", "armlink only listens to this arm, so its drives were not asked", name, look)
        return
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
        more = f"check power, wiring and bit rate; `armlink scan {arm_file.argument}` shows more"
        yield SetupFinding("error", str(error), name, more)
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
            "armlink cannot detect this error: use a multi-turn encoder, or check the reading of "
            "such a joint after each power-on, before it moves",
        )


def silence_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Joints that no command gives power, since nothing stops their drives when the host dies."""
    try:
        groups = make_groups(arm_file)
    except ArmlinkError:  # as above
        return
    link = arm_file.require_link()
    joints = zip(link.joints, traits_of(groups), strict=True)
    found = [joint.name for joint, traits in joints if traits.reaction(link.keeper) == "keeps on" and not traits.heard]
    if found:
        yield SetupFinding(
            "warning",
            f"if the host dies, the drives of these joints keep on with their last command: {', '.join(found)}",
            f"{arm_file.path}: link.joints",
            "armlink reads these drives but never enables them: state the time-out that is set in each, if there is "
            "one (docs/drive-families.md), or set `link.keeper: true` (docs/safety.md)",
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
    remedy = "connect the right arm, or correct the entry of this joint under link.joints of the arm file"
    return SetupFinding("error", mismatch, where, remedy)


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
            corrected = f"this is corrected at each start: {link.turns.note(each.joint)}"
            yield SetupFinding("hint", each.what, where, corrected)


FORMATS = "docs/formats.md has every key with its unit and range"


def examine(arm: str, bus: str | None = None, offline: bool = False) -> list[SetupFinding]:
    """All findings, errors first, then in the order in which they are to be dealt with.

    `bus` replaces the arm file's; `offline` leaves the bus alone. The drives are only read.
    """
    return sorted(_all(arm, bus, offline), key=lambda found: get_args(Level).index(found.level))


def _all(arm: str, bus: str | None, offline: bool) -> Iterator[SetupFinding]:
    try:
        arm_file = load_arm(arm)
    except BadKeys as error:
        for key, message in error.keys:
            what, _, hint = message.partition("; did you mean ")
            remedy = f"did you mean {hint} Rename it" if hint else f"correct this key in the arm file: {FORMATS}"
            yield SetupFinding("error", what, f"{arm}: {key}", remedy)
        return
    except ArmlinkError as error:
        remedy = "correct the arm file, or make a new one from a model (see new --help)"
        yield SetupFinding("error", str(error), arm, remedy)
        return
    impossible = list[SetupFinding]()
    try:
        impossible += sweep_errors(arm_file)
        yield from impossible
        if not impossible:
            yield from model_findings(arm_file)
            yield from motion_findings(arm_file)
    except (ArmlinkError, GcompError) as error:  # what later checks rest upon
        what, _, remedy = str(error).removeprefix(f"{arm_file.path}: ").rpartition(": ")
        if not what:
            what, remedy = remedy, "correct the arm file or its model"
        yield SetupFinding("error", what, str(arm_file.path), remedy)
    if arm_file.link is None:
        what = "key `link` is missing: the bus and the drives of the joints are not known"
        yield SetupFinding("error", what, arm, f"add the key `link`: {FORMATS}")
    else:
        yield from _serial(arm_file, bus)
        yield from turn_findings(arm_file)
        yield from silence_findings(arm_file)
        if not offline and not impossible:
            yield from bus_findings(arm_file, bus)
    yield from _assumed(arm, arm_file)


def _serial(arm_file: ArmFile, bus: str | None) -> Iterator[SetupFinding]:
    """Records are kept under name and serial number: without one, two arms would share them."""
    if not arm_file.has_serial:
        yield SetupFinding(
            "hint" if is_in_process(arm_file, bus) else "warning",
            f"serial is {arm_file.serial}: another arm of this name would share the calibrations of this "
            "arm, so they are written only to an arm that is simulated in this process",
            str(arm_file.path),
            "give the real arm a serial number before its first sweep (`serial: …`)",
        )


def _assumed(arm: str, arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Values that armlink new assumed and nobody has confirmed yet."""
    if arm in bundled_arms():
        return
    assumed = assumed_lines(Path(arm_file.path).read_text(encoding="utf-8"))
    if assumed:
        what = f"{len(assumed)} values are marked as assumed, the first is in line {assumed[0]}"
        yield SetupFinding("hint", what, str(arm_file.path), "check each of these values, then remove its comment")
