"""Lists the drives on the bus with their identity and state; writes nothing to them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Json, OtherBus
from armlink.commands.output import write_json
from armlink.errors import BadInput, BusFault, Refused

if TYPE_CHECKING:
    from rich.table import Table

    from armlink.arm_file import ArmFile


def scan(
    arm: Annotated[str | None, typer.Argument(help="Bundled arm or path of an arm file; default: all drives.")] = None,
    bus: OtherBus = None,
    json: Json = None,
) -> int:
    """List the drives that answer on a bus, or the drives of an arm and which of them do not answer (status 3).

    Exit status 1 if a joint has another drive than the arm file states (link.joints, key identity).

    Example: armlink scan sarcos --bus socketcan:vcan0
    """
    from armlink.arm_file import load_arm
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.drives.family import family
    from armlink.loop.open import first_check

    if arm is None:
        if bus is None:
            raise BadInput("scan: give an arm file, or --bus INTERFACE:CHANNEL[@BITRATE]")
        return _look_for_all(bus, json)
    described = load_arm(arm)
    kinds = {joint.settings.family for joint in described.require_link().joints}
    search = family(kinds.pop()).search if len(kinds) == 1 else None
    if search is not None:
        status = search(described, bus, json, write_json, results(json).print)
    else:
        status = _ask_all(described, bus, json)
    if status == 0:
        suggest(command_line(*first_check(described, arm, bus), bus=bus))
    return status


def _look_for_all(bus: str, json: Path | None) -> int:
    from armlink.arm_file import Bus
    from armlink.bus.open import open_bus
    from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
    from armlink.drives.discovery import BusDrives

    opened = open_bus(bus, Bus())
    try:
        with PlainConsole().status(f"looking for drives on {opened.channel_info}"):
            drives, channel = BusDrives(opened), str(opened.channel_info)
    finally:
        opened.shutdown()
    nodes, out = drives.nodes, results(json)
    out.print(_table(channel, nodes, ("model", "reply")) if nodes else f"{channel}: no drive answers")
    for line in filter(None, dict.fromkeys(node[key] for node in nodes for key in ("wrong", "note"))):
        out.print(f"{', '.join(each['address'] for each in nodes if line in (each['wrong'], each['note']))}: {line}")
    write_json(json, {"bus": channel, "nodes": nodes})
    out.print(drives.told)
    drives.require_own_ids()
    if nodes:
        out.print(f"{len(nodes)} drives answer")
        suggest(command_line("new", out="arm.yaml", bus=bus))
    return 0


def _ask_all(arm: "ArmFile", bus: str | None, json: Path | None) -> int:
    from armlink.commands.plain_console import results
    from armlink.link.joints.groups import traits_of
    from armlink.link.link import Link

    with Link.open(arm, bus) as link:
        found, channel = link.scan(), str(link.bus.channel_info)
        traits = traits_of(link.groups)
    nodes = []
    for each in found:
        name, kind = link.names[each.joint], link.section.joints[each.joint].settings.family
        node = {**vars(each), "joint": name, "family": kind, "power": each.power.value}
        nodes.append(node | {"traits": traits[each.joint].as_json()})
    out = results(json)
    out.print(_table(channel, nodes))
    write_json(json, {"bus": channel, "nodes": nodes})
    missing = [f"{link.names[each.joint]} ({each.address})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}: check power, wiring and ids")
    wrong = [f"{link.names[each.joint]} ({each.address}): {each.mismatch}" for each in found if each.mismatch]
    if wrong:
        raise Refused(
            f"{wrong[0]}: connect the right arm, or correct the entry of this joint under link.joints of the arm file"
        )
    out.print(f"all {len(found)} joints answer")
    return 0


def _table(channel: str, nodes: list[dict[str, Any]], more: tuple[str, ...] = ()) -> "Table":
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    heads = ("joint", "family", "id", "state", "device", "serial", "firmware", *more)
    rows = []
    for node in nodes:
        state = node["power"] if node["present"] else Text("no answer", style="red")
        told = [f"{node[key]:02X}h" if isinstance(node[key], int) else node[key] for key in more]
        cells = (node["joint"], node["family"], node["address"], state, node["name"], str(node["serial"]))
        rows.append((*cells, node["firmware"], *told))
    table = Table(box=SIMPLE, title=channel)
    told_of = [place for place, column in enumerate(zip(*rows, strict=True)) if any(column)]
    for place in told_of:
        table.add_column(heads[place], overflow="fold" if heads[place] == "joint" else "ellipsis")
    for row in rows:
        table.add_row(*(row[place] for place in told_of))
    return table
