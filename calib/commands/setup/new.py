"""Makes an arm file from a URDF or MJCF model, and finds its drives on a bus."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.output import write_json
from armlink.errors import BadInput
from calib.commands.options import JsonFile

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.bus.can_bus import CanBus
    from armlink.drives.discovery import BusDrives
    from armlink.drives.findings import SetupFinding
    from calib.commissioning.drive_match import Ask, Match
    from calib.commissioning.new_arm import NewArm

SCHEMA = "armlink.new/1"


def new(
    model: Annotated[
        Path | None,
        typer.Argument(
            help="URDF or MJCF model of the arm. With --bus: a model, an arm file, or nothing (the drives alone).",
            metavar="MODEL_OR_ARM",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Arm file to write; by default named like the model, in this folder (arm.yaml without a model)."
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(help="Body that carries the arm, such as a torso; by default the world.", rich_help_panel="Model"),
    ] = None,
    tip: Annotated[
        str | None,
        typer.Option(help="Last body of the arm; by default the end of the longest chain.", rich_help_panel="Model"),
    ] = None,
    stops: Annotated[
        list[str] | None,
        typer.Option(
            help="JOINT:LOWER:UPPER [rad], instead of the limits of the model; may be repeated.",
            rich_help_panel="Model",
        ),
    ] = None,
    rated_torque: Annotated[
        list[str] | None,
        typer.Option(
            help="JOINT:TORQUE [N·m], instead of the effort limit of the model; may be repeated.",
            rich_help_panel="Model",
        ),
    ] = None,
    lock: Annotated[
        list[str] | None,
        typer.Option(
            help="JOINT:POSITION [rad, m]: a joint that these drives do not move, such as a lift; default "
            "position 0; may be repeated.",
            rich_help_panel="Model",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the arm; by default the name of the arm file.")] = None,
    bus: Annotated[
        str | None,
        typer.Option(
            help="INTERFACE:CHANNEL[@BITRATE]: find the drives on this bus and write them to the arm file.",
            rich_help_panel="Drives on a bus",
        ),
    ] = None,
    by_hand: Annotated[
        bool | None,
        typer.Option(
            help="With --bus: find each joint's drive, direction and gear by turning the joint by hand, without "
            "power; with --no-by-hand, take the drives in the order of their node ids. By default the command asks.",
            show_default=False,
            rich_help_panel="Drives on a bus",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    json_file: JsonFile = None,
) -> int:
    """Write an arm file that demo, sweep and check accept unchanged.

    The arm is the longest chain of revolute joints. Gripper, mimic and prismatic joints at its end are not part of it,
    nor are joints that carry --base or that --lock names. Limits and torques are taken from the model. What the model
    does not state is asked on a terminal, or else assumed; a comment marks every assumed value. Drives on the bus are
    only read. Exit status 1 if a joint turns in the other direction or has another gear than the model. Without a
    model, the arm file is made from the drives on --bus; only its geometry is missing, so it is enough for check,
    monitor and record.

    Example: armlink new arm.urdf --out arm.yaml
    """
    from armlink.arm_file import bundled_arms, load_arm
    from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
    from armlink.loop.open import first_check
    from armlink.model_file import MODEL_SUFFIXES, expand_xacro
    from calib.commands.setup.terminal import Terminal, hand, parse_locks, parse_ratings, parse_stops
    from calib.commissioning.drive_match import drives_have_ids
    from calib.commissioning.new_arm import new_arm

    console = PlainConsole()
    interactive = sys.stdin is not None and sys.stdin.isatty()
    if bus is None and by_hand:
        raise BadInput("--by-hand needs --bus, the bus of the drives")
    if model is None:
        if bus is None:
            raise BadInput(
                "new: give a URDF or MJCF model of the arm, or `--bus INTERFACE:CHANNEL` to begin with the drives alone"
            )
        if base or tip or stops or rated_torque or lock:
            raise BadInput(
                "--base, --tip, --stops, --rated-torque and --lock belong to a model: give a model, or "
                "change the arm file afterwards"
            )
        out = out or Path("arm.yaml")
        _require_free(out, force, interactive)
        return begin_with_drives(out, bus, name, _hand(bus, by_hand, interactive), json_file)
    bundled = bundled_arms().get(str(model))
    is_arm_file = bundled is not None or model.suffix.lower() in (".yaml", ".yml")
    if is_arm_file and bus is None:
        raise BadInput(
            f"{model} is an arm file already: give --bus to find its drives, or check it with `armlink doctor {model}`"
        )
    if is_arm_file and (base or tip or stops or rated_torque or lock or name):
        options = "--base, --tip, --stops, --rated-torque, --lock and --name"
        raise BadInput(f"{model}: {options} belong to a model: change the arm file itself")
    is_xacro = model.suffix.lower() == ".xacro"
    if not is_arm_file and not is_xacro and model.suffix.lower() not in MODEL_SUFFIXES:
        suffixes = ", ".join((*MODEL_SUFFIXES, ".xacro"))
        raise BadInput(f"{model}: expected a URDF or MJCF model ({suffixes}), or an arm file (.yaml)")
    out = out or Path(f"{Path(model.stem).stem if is_xacro else model.stem}.yaml")
    found = bundled or model
    have_ids = is_arm_file and drives_have_ids(load_arm(found))
    if not found.is_file():  # before anything is asked
        raise BadInput(f"there is no model file {model}: give the path of a URDF or MJCF file")
    _require_free(out, force, interactive)
    if is_xacro:
        model = expand_xacro(model, out.with_suffix(".urdf"))
    if is_arm_file:
        by_ids = have_ids and not by_hand
        ask = None if by_ids else _hand(str(bus), by_hand, interactive)
        return rewire(found, out, str(bus), ask, by_ids=by_ids, bundled=bundled is not None, json=json_file)
    if bus is not None:
        open_named(bus).shutdown()  # before anything is asked: answers are not lost to a bus that is not there
    with console.status(f"reading {model.name} and looking for collisions"):
        asked = Terminal(console) if interactive else None
        made = new_arm(
            model,
            out,
            base=base,
            tip=tip,
            stops=parse_stops(stops or []),
            ratings=parse_ratings(rated_torque or []),
            locked=parse_locks(lock or []),
            name=name,
            questions=asked,
        )
    if bus is not None:
        with opened_bus(bus) as opened:
            drives, keys = search(opened, bus, out)
            made.wire(drives, str(opened.channel_info), hand(by_hand, interactive), keys)
    arm = made.parsed()
    made.write()
    _show(results(json_file), made, arm)
    step = command_line("demo", arm=out) if bus is None else command_line(*first_check(arm, str(out)))
    suggest(step)
    write_json(json_file, _answer(made, arm, step))
    return exit_status(made.findings)


def _hand(bus: str, by_hand: bool | None, interactive: bool) -> "Ask | None":
    """How a person is asked to turn a joint, on a bus that is there: answers are not lost to another."""
    from calib.commands.setup.terminal import hand

    open_named(bus).shutdown()
    return hand(by_hand, interactive)


def _require_free(out: Path, force: bool, interactive: bool) -> None:
    from armlink.commands.plain_console import confirm

    if out.suffix.lower() not in (".yaml", ".yml"):
        raise BadInput(f"--out {out}: expected a file that ends in .yaml")
    if not out.exists() or force:
        return
    if not interactive:
        raise BadInput(f"{out} exists already: choose another `--out`, or give `--force` to replace the file")
    confirm(f"{out} exists. Replace it?")


def _show(console: Any, made: "NewArm", arm: "ArmFile") -> None:
    from rich.table import Table

    from calib.commissioning.draft import assumed_lines

    draft = made.draft
    ends = "stops [rad]" if draft.servo is None else "range [rad]"
    table = Table("joint", "drive", ends, "rated [N·m]", "largest [N·m]", title=f"{draft.name}: {made.out}")
    for planned, joint in zip(draft.joints, arm.require_link().joints, strict=True):
        stops = "from the model" if planned.stops is None else f"{planned.stops[0]:+.2f} {planned.stops[1]:+.2f}"
        table.add_row(joint.name, joint.settings.address, stops, f"{joint.rated_torque:g}", f"{joint.max_torque:g}")
    console.print(table)
    for why in dict.fromkeys(why for _, why in draft.aside):
        names = [name for name, reason in draft.aside if reason == why]
        if len(names) == 1:
            console.print(f"joint {names[0]} {why}, so it is not part of the arm")
        else:
            console.print(f"{len(names)} joints are not part of the arm, since each {why}: {', '.join(names)}")
    for note in draft.notes:
        console.print(note, style="yellow")
    if draft.servo is not None:
        console.print(f"joints at rest are held by their position loops, since {draft.servo}", style="yellow")
    show_findings(console, made.findings)
    console.print(
        f"{made.out} is written; {len(assumed_lines(made.text))} values are assumed, each is marked in the file"
    )


def _answer(made: "NewArm", arm: "ArmFile", step: str) -> dict[str, Any]:
    from calib.commissioning.drive_match import drive_id

    draft = made.draft
    return {
        "schema": SCHEMA,
        "out": str(made.out),
        "name": draft.name,
        "model": str(draft.model),
        "base": draft.base,
        "tip": draft.tip,
        "joints": [
            {
                "name": joint.name,
                "node": drive_id(joint),
                "rated_torque": joint.rated_torque,
                "max_torque": joint.max_torque,
                "max_velocity": joint.max_velocity,
                "stops": planned.stops,
            }
            for planned, joint in zip(draft.joints, arm.require_link().joints, strict=True)
        ],
        "aside": [{"joint": name, "why": why} for name, why in draft.aside],
        "assumed": draft.assumed,
        "findings": [vars(found) for found in made.findings],
        "next": step,
    }


def begin_with_drives(out: Path, bus: str, name: str | None, ask: "Ask | None", json_file: Path | None) -> int:
    """An arm file made from a bus alone: it has the drives, but no geometry."""
    from calib.commissioning.drive_match import arm_of_bus

    with opened_bus(bus) as opened:
        drives, keys = search(opened, bus, out)
        text, matches = arm_of_bus(drives, str(opened.channel_info), keys, name or out.stem, ask)
    arm = _written(out, text)
    return _tell(out, arm, matches, "; the geometry is not known (see the file)", [], json_file)


def rewire(
    model: Path, out: Path, bus: str, ask: "Ask | None", *, by_ids: bool, bundled: bool, json: Path | None
) -> int:
    """An arm file with the drives of a bus; `by_ids`: each drive is asked for its identity at its id in the file.

    A copy of a `bundled` arm takes the serial number of its first drive.
    """
    from armlink.arm_file import Bus, load_arm
    from armlink.content.file_content import read_whole
    from armlink.content.yaml_text import yaml_comment
    from calib.commissioning.drive_match import match_by_ids, match_drives, wired_text

    arm = load_arm(model)
    with opened_bus(bus) as opened:
        channel = str(opened.channel_info)
        if by_ids:
            keys = bus_keys(bus, out, {joint.settings.family for joint in arm.require_link().joints})
            matches, findings = match_by_ids(arm, opened, Bus.model_validate(keys))
        else:
            drives, keys = search(opened, bus, out)
            matches, findings = match_drives(arm, drives, channel, ask)
    serial = (matches[0].drive.serial or "unknown") if bundled else ""
    text, doubts = wired_text(read_whole(model).decode(), arm, matches, out, keys, serial)
    if out.resolve() != model.resolve():
        title = f"{arm.name} with the drives on {channel}: made from {model.name} by `armlink new`."
        text = f"{yaml_comment(title)}\n{text}"
    arm = _written(out, text)
    where = "each at the joint with the same id in the file" if by_ids else "in the order of their ids, as assumed"
    more = "" if all(each.by_hand for each in matches) else f", {where}: --by-hand checks it"
    return _tell(out, arm, matches, more, findings + doubts, json)


def _written(out: Path, text: str) -> "ArmFile":
    """Write an arm file that can be read."""
    from armlink.arm_file import parse_arm
    from armlink.content.atomic_file import write_whole
    from armlink.content.file_content import parse_yaml

    arm = parse_arm(parse_yaml(text, out), out)
    write_whole(out, text)
    return arm


def _tell(
    out: Path,
    arm: "ArmFile",
    matches: "Sequence[Match]",
    more: str,
    findings: "Sequence[SetupFinding]",
    json_file: Path | None,
) -> int:
    """Findings, what was written and the next command, to the screen and as JSON; the exit status."""
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


@contextmanager
def opened_bus(bus: str) -> "Iterator[CanBus]":
    opened = open_named(bus)
    try:
        yield opened
    finally:
        opened.shutdown()


def search(opened: "CanBus", bus: str, out: Path) -> "tuple[BusDrives, dict[str, Any]]":
    """The drives on an open bus, and the keys of link.bus; prints the families that were looked for, and settings that
    must be changed."""
    from armlink.commands.plain_console import PlainConsole
    from armlink.drives.discovery import BusDrives

    console = PlainConsole()
    with console.status(f"looking for drives on {opened.channel_info}"):
        drives = BusDrives(opened)
    for line in (drives.told, *(f"{node['address']}: {node['wrong']}" for node in drives.nodes if node["wrong"])):
        console.print(line)
    return drives, bus_keys(bus, out, {each.family for each in drives.found})


def bus_keys(bus: str, out: Path, families: set[str]) -> dict[str, Any]:
    """Keys of link.bus for a bus given on the command line, with drives of these families; for a simulated bus, the
    path of its arm file is relative to `out`."""
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
