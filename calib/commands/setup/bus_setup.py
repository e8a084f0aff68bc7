"""The parts of `armlink new` that begin with the drives on a bus: of an arm file, and of nothing else."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlink.content.atomic_file import write_whole
from armlink.content.file_content import parse_yaml

if TYPE_CHECKING:
    from collections.abc import Sequence

    from armlink.arm_file import ArmFile
    from armlink.bus.can_bus import CanBus
    from armlink.drives.discovery import BusDrives
    from armlink.drives.findings import SetupFinding
    from calib.commissioning.drive_match import Ask, Match

SCHEMA = "armlink.new/1"


def begin_with_drives(out: Path, bus: str, name: str | None, ask: "Ask | None", json_file: Path | None) -> int:
    """An arm file made from a bus alone: it has the drives, but no geometry."""
    from armlink.arm_file import parse_arm
    from calib.commissioning.drive_match import arm_of_bus

    opened = open_named(bus)
    try:
        drives = search(opened)
        keys = bus_keys(bus, out, {each.family for each in drives.found})
        text, matches = arm_of_bus(drives, str(opened.channel_info), keys, name or out.stem, ask)
    finally:
        opened.shutdown()
    arm = parse_arm(parse_yaml(text, out), out)
    write_whole(out, text)
    return _tell(out, arm, matches, "; the geometry is not known (see the file)", [], json_file)


def rewire(
    model: Path, out: Path, bus: str, ask: "Ask | None", *, by_ids: bool, bundled: bool, json: Path | None
) -> int:
    """An arm file with the drives of a bus; `by_ids`: each drive is asked for its identity at its id in the file.

    A copy of a `bundled` arm takes the serial number of its first drive.
    """
    from armlink.arm_file import Bus, load_arm, parse_arm
    from armlink.content.file_content import read_whole
    from armlink.content.yaml_text import yaml_comment
    from calib.commissioning.drive_match import match_by_ids, match_drives, wired_text

    arm, opened = load_arm(model), open_named(bus)
    try:
        channel = str(opened.channel_info)
        if by_ids:
            keys = bus_keys(bus, out, {joint.settings.family for joint in arm.require_link().joints})
            matches, findings = match_by_ids(arm, opened, Bus.model_validate(keys))
        else:
            drives = search(opened)
            keys = bus_keys(bus, out, {each.family for each in drives.found})
            matches, findings = match_drives(arm, drives, channel, ask)
    finally:
        opened.shutdown()
    serial = (matches[0].drive.serial or "unknown") if bundled else ""
    text, doubts = wired_text(read_whole(model).decode(), arm, matches, out, keys, serial)
    if out.resolve() != model.resolve():
        title = f"{arm.name} with the drives on {channel}: made from {model.name} by `armlink new`."
        text = f"{yaml_comment(title)}\n{text}"
    arm = parse_arm(parse_yaml(text, out), out)
    write_whole(out, text)
    where = "each at the joint with the same id in the file" if by_ids else "in the order of their ids, as assumed"
    more = "" if all(each.by_hand for each in matches) else f", {where}: --by-hand checks it"
    return _tell(out, arm, matches, more, findings + doubts, json)


def _tell(
    out: Path,
    arm: "ArmFile",
    matches: "Sequence[Match]",
    more: str,
    findings: "Sequence[SetupFinding]",
    json_file: Path | None,
) -> int:
    """Findings, what was written and the next command, to the screen and as JSON; the exit status."""
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.loop.open import first_check
    from calib.commissioning.drive_match import addresses

    console = results(json_file)
    show_findings(console, findings)
    step = command_line(*first_check(arm, str(out)))
    console.print(f"{out} is written with {len(matches)} drives: {addresses([each.drive for each in matches])}{more}")
    suggest(step)
    joints = [
        {"name": each.joint, "node": each.drive.node, "by_hand": each.by_hand}
        | {"address": each.drive.address, "serial": each.drive.serial}
        for each in matches
    ]
    answer = {"out": str(out), "name": arm.name, "joints": joints, "next": step}
    write_json(json_file, {"schema": SCHEMA, **answer, "findings": [vars(found) for found in findings]})
    return exit_status(findings)


def show_findings(console: Any, findings: "Sequence[SetupFinding]") -> None:
    for found in findings:
        console.print(str(found), style="red" if found.level == "error" else "yellow")


def exit_status(findings: "Sequence[SetupFinding]") -> int:
    return 1 if any(found.level == "error" for found in findings) else 0


def open_named(bus: str) -> "CanBus":
    """The bus of the option --bus; raises BadInput, BusFault."""
    from armlink.arm_file import Bus
    from armlink.bus.open import open_bus

    return open_bus(bus, Bus())


def search(opened: "CanBus") -> "BusDrives":
    """The drives on an open bus; prints the families that were looked for, and settings that must be changed."""
    from armlink.commands.plain_console import PlainConsole
    from armlink.drives.discovery import BusDrives

    console = PlainConsole()
    with console.status(f"looking for drives on {opened.channel_info}"):
        drives = BusDrives(opened)
    for line in (drives.told, *(f"{node['address']}: {node['wrong']}" for node in drives.nodes if node["wrong"])):
        console.print(line)
    return drives


def bus_keys(bus: str, out: Path, families: set[str]) -> dict[str, Any]:
    """Keys of link.bus for a bus given on the command line, with drives of these families; for a simulated bus, the
    path of its arm file is relative to `out`."""
    import os

    from armlink.bus.open import parse_bus
    from armlink.drives.family import family

    parsed = parse_bus(bus)
    channel = parsed.channel
    if Path(channel).is_file():
        channel = os.path.relpath(Path(channel).resolve(), out.resolve().parent)
    keys: dict[str, Any] = {"interface": parsed.interface, "channel": channel, "bitrate": parsed.bitrate}
    if parsed.fd or any(family(kind).traits.frame == "fd" for kind in families):
        keys["fd"] = True
    return keys | ({"options": parsed.options} if parsed.options else {})
