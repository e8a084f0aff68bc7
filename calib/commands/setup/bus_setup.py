"""The parts of `armlink new` that begin with the drives on a bus: of an arm file, and of nothing else."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlink.content.atomic_file import write_whole
from armlink.content.file_content import parse_yaml

if TYPE_CHECKING:
    from collections.abc import Sequence

    from armlink.bus.can_bus import CanBus
    from armlink.drives.discovery import BusDrives
    from armlink.drives.findings import FoundDrives, SetupFinding
    from calib.commissioning.drive_match import Ask, Match

SCHEMA = "armlink.new/1"


def begin_with_drives(out: Path, bus: str, name: str | None, ask: "Ask | None", json_file: Path | None) -> int:
    """An arm file of nothing but a bus: its drives, and no geometry."""
    from armlink.arm_file import parse_arm
    from calib.commissioning.drive_match import addresses, arm_of_bus

    opened = open_named(bus)
    try:
        drives = search(opened)
        made = arm_of_bus(drives, str(opened.channel_info), bus_keys(bus, out, drives), name or out.stem, ask)
    finally:
        opened.shutdown()
    parse_arm(parse_yaml(made.text, out), out)
    write_whole(out, made.text)
    ids = addresses([match.drive for match in made.matches])
    told = f"{len(made.matches)} joints, {ids}; the geometry is not known, as the file says"
    return _tell(out, told, "check", name or out.stem, _matched(made.matches), [], json_file)


def rewire(model: Path, out: Path, bus: str, ask: "Ask | None", json_file: Path | None) -> int:
    from armlink.arm_file import load_arm, parse_arm
    from armlink.content.file_content import parse_yaml
    from armlink.content.yaml_text import yaml_comment
    from calib.arm.kinematics import gcomp_arm
    from calib.commissioning.drive_match import TurnedJoint, addresses, match_by_hand, match_in_order
    from calib.commissioning.new_arm import rewired_text

    arm = load_arm(model)
    arm.require_link()
    findings: list[SetupFinding] = []
    opened = open_named(bus)
    try:
        drives, channel = search(opened), str(opened.channel_info)
        if ask is None:
            matches = match_in_order(arm.joint_names, drives, channel)
        else:
            known = gcomp_arm(arm)
            settings = [joint.settings for joint in arm.require_link().joints]
            gears = [1.0 if each.family == "canopen" else each.gear for each in settings]
            turned = [TurnedJoint(*each) for each in zip(known.names, known.lower, known.upper, gears, strict=True)]
            matches, findings = match_by_hand(turned, drives, channel, ask)
    finally:
        opened.shutdown()
    text = rewired_text(arm, matches, bus_keys(bus, out, drives), out)
    parse_arm(parse_yaml(text, out), out)
    title = f"{arm.name} with the drives on {channel}: made from {model.name} by `armlink new`."
    write_whole(
        out, yaml_comment(f"{title} Nodes, rated torques and identities were read from the drives.") + "\n" + text
    )
    told = addresses([match.drive for match in matches])
    return _tell(out, told, "check", arm.name, _matched(matches), findings, json_file)


def drives_by_ids(model: Path) -> bool:
    """Whether the drives of an arm file are found by the ids that stand in it."""
    from armlink.arm_file import load_arm
    from calib.commissioning.own_copy import drives_have_ids

    return drives_have_ids(load_arm(model))


def copy(model: Path, out: Path, bus: str, new_serial: bool, json_file: Path | None) -> int:
    """An arm file with drives that are known by their ids, on a bus of one's own."""
    from armlink.arm_file import load_arm
    from calib.commissioning.own_copy import own_copy

    arm, opened = load_arm(model), open_named(bus)
    try:
        copied = own_copy(arm, out, bus_keys(bus, out), opened, new_serial=new_serial)
    finally:
        opened.shutdown()
    write_whole(out, copied.text)
    told = f"{', '.join(address for _, address, _ in copied.drives)} answer; the limits are copied from {model}"
    joints = [{"name": name, "address": address, "serial": serial} for name, address, serial in copied.drives]
    return _tell(out, told, "doctor", arm.name, joints, copied.findings, json_file)


def _matched(matches: "Sequence[Match]") -> list[dict[str, Any]]:
    return [{"name": match.joint, "node": match.drive.node, "by_hand": match.by_hand} for match in matches]


def _tell(
    out: Path,
    told: str,
    command: str,
    name: str,
    joints: list[dict[str, Any]],
    findings: "Sequence[SetupFinding]",
    json_file: Path | None,
) -> int:
    """Findings, what was written and the next command, to the screen and as JSON; the exit status."""
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest

    console = results(json_file)
    for found in findings:
        console.print(str(found), style="red")
    step = command_line(command, str(out))
    console.print(f"{out}: {told}")
    suggest(step)
    answer = {"out": str(out), "name": name, "joints": joints, "next": step}
    write_json(json_file, {"schema": SCHEMA, **answer, "findings": [vars(found) for found in findings]})
    return 1 if findings else 0


def open_named(bus: str) -> "CanBus":
    """The bus of the option --bus; raises BadInput, BusFault."""
    from armlink.arm_file import Bus
    from armlink.bus.open import open_bus

    return open_bus(bus, Bus())


def search(opened: "CanBus") -> "BusDrives":
    """The drives on an open bus; which families were looked for is said, and what must be set otherwise in a drive."""
    from armlink.commands.plain_console import PlainConsole
    from armlink.drives.discovery import BusDrives

    drives = BusDrives(opened)
    for line in (drives.told, *(f"{node['address']}: {node['wrong']}" for node in drives.nodes if node["wrong"])):
        PlainConsole().print(line)
    return drives


def bus_keys(bus: str, out: Path, drives: "FoundDrives | None" = None) -> dict[str, Any]:
    """Keys of link.bus for a bus given on the command line, with these drives; the arm file of a simulated one relative
    to `out`."""
    import os

    from armlink.bus.open import parse_bus
    from armlink.drives.family import family

    parsed = parse_bus(bus)
    channel = parsed.channel
    if Path(channel).is_file():
        channel = os.path.relpath(Path(channel).resolve(), out.resolve().parent)
    keys: dict[str, Any] = {"interface": parsed.interface, "channel": channel, "bitrate": parsed.bitrate}
    kinds = {each.family for each in drives.found} if drives is not None else set()
    if parsed.fd or any(family(kind).traits.frame == "fd" for kind in kinds):
        keys["fd"] = True
    return keys | ({"options": parsed.options} if parsed.options else {})
