"""Lists the drives on the bus with their identity and state; writes nothing to them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from armlink.commands.options import Json, OtherBus

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile

SEARCHED = "canopen"
"""Family whose drives can be found on a bus without an arm file."""


def scan(
    arm: Annotated[
        str | None, typer.Argument(help="Bundled arm or path of an arm file; without an arm, all nodes are listed.")
    ] = None,
    bus: OtherBus = None,
    json: Json = None,
) -> int:
    """List the nodes that answer on a bus; with an arm file also its joints that do not answer (exit status 3).

    Exit status 1 if a joint has another drive than the arm file states (link.joints, key identity).

    Example: armlink scan sarcos --bus socketcan:vcan0
    """
    from armlink.arm_file import load_arm
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
    from armlink.drives.registry import family, not_looked_for
    from armlink.errors import BadInput

    if arm is None and bus is None:
        raise BadInput("scan: give an arm file, or --bus INTERFACE:CHANNEL[@BITRATE]")
    described = None if arm is None else load_arm(arm)
    kinds = set() if described is None else {joint.settings.family for joint in described.require_link().joints}
    search = family(kinds.pop() if len(kinds) == 1 else SEARCHED).search if len(kinds) < 2 else None
    if search is not None:
        status = search(described, bus, json, write_json, results(json).print)
    else:
        assert described is not None
        status = _ask_all(described, bus, json)
    if arm is not None and status == 0:
        suggest(command_line("check", arm, bus=bus))
    if arm is None:
        PlainConsole().print(not_looked_for())
    return status


def _ask_all(arm: "ArmFile", bus: str | None, json: Path | None) -> int:
    """The drives of an arm, each asked for its identity."""
    from rich.box import SIMPLE
    from rich.table import Column, Table
    from rich.text import Text

    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.errors import BusFault, Refused
    from armlink.link.joints.groups import traits_of
    from armlink.link.link import Link

    with Link.open(arm, bus) as link:
        found, channel = link.scan(), str(link.bus.channel_info)
        traits = traits_of(link.groups)
    table = Table(
        Column("joint", overflow="fold"),
        "family",
        "id",
        "state",
        "device",
        "serial",
        "firmware",
        box=SIMPLE,
        title=channel,
    )
    nodes = []
    for each in found:
        name, kind = link.names[each.joint], link.section.joints[each.joint].settings.family
        state = each.power.value if each.present else Text("no answer", style="red")
        table.add_row(name, kind, each.address, state, each.name, each.serial, each.firmware)
        node = {**vars(each), "joint": name, "family": kind, "power": each.power.value}
        nodes.append(node | {"traits": traits[each.joint].as_json()})
    out = results(json)
    out.print(table)
    write_json(json, {"bus": channel, "nodes": nodes})
    missing = [f"{link.names[each.joint]} ({each.address})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}")
    wrong = [f"{link.names[each.joint]} ({each.address}): {each.mismatch}" for each in found if each.mismatch]
    if wrong:
        raise Refused(
            f"{wrong[0]}: connect the right arm, or correct the entry of this joint under link.joints of the arm file"
        )
    out.print(f"all {len(found)} joints answer")
    return 0
