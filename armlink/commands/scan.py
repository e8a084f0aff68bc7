"""Lists the nodes on the bus with their identity and state; writes nothing to them."""

from pathlib import Path
from typing import Annotated

import typer


def scan(
    arm: Annotated[str | None, typer.Argument(help="Bundled arm or path of an arm file; without: all nodes.")] = None,
    bus: Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the answer here; - is standard output.")] = None,
) -> int:
    """List the nodes that answer on a bus; with an arm file also those of its joints that do not (exit status 3).

    Exit status 1 where a joint has another controller than the arm file states (link.joints, key identity).

    Example: armlink scan sarcos --bus socketcan:vcan0
    """
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from armlink.arm_file import Bus, load_arm
    from armlink.bus.open import open_bus, open_link_bus
    from armlink.clock import MonotonicClock
    from armlink.commands.output import write_json
    from armlink.drives.canopen.eds_file import expected_identity, of_joints
    from armlink.errors import BadInput, BusFault
    from armlink.link.controller_setup import identity_mismatches, refused_identity
    from armlink.monitor.scan import describe_type, scan_bus

    if arm is None and bus is None:
        raise BadInput("scan: give an arm file, or --bus INTERFACE:CHANNEL[@BITRATE]")
    if arm is None:
        joints, stated = {}, {}
        opened = open_bus(bus, Bus())
    else:
        described = load_arm(arm)
        link, sheets = described.require_link(), of_joints(described)
        joints = {joint.settings.node: joint.name for joint in link.joints}
        stated = {
            each.settings.node: expected_identity(each, sheet) for each, sheet in zip(link.joints, sheets, strict=True)
        }
        opened = open_link_bus(bus, link)
    try:
        clock = opened.clock or MonotonicClock()
        found = scan_bus(opened.open_port(), clock, joints)
        channel = str(opened.channel_info)
    finally:
        opened.shutdown()
    wrong = {
        each.node: differs
        for each in found
        if each.present and each.node in stated and (differs := identity_mismatches(stated[each.node], vars(each)))
    }
    table = Table("node", "joint", "state", "device", "identity", "serial", box=SIMPLE, title=channel)
    for each in found:
        if each.present:
            told = (each.state.value, each.name or describe_type(each.device_type))
            identity = f"{each.vendor:x}:{each.product:x}:{each.revision:x}"
            style = "red" if each.node in wrong or each.answers > 1 else ""
            table.add_row(str(each.node), each.joint, *told, identity, str(each.serial), style=style)
        else:
            table.add_row(str(each.node), each.joint, "[red]no answer[/red]")
    Console(stderr=True).print(table if found else f"{channel}: no node answers")
    nodes = [{**vars(each), "state": each.state.value, "mismatches": wrong.get(each.node, [])} for each in found]
    write_json(json, {"bus": channel, "nodes": nodes})
    missing = [f"{each.joint} (node {each.node})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}")
    twins = [str(each.node) for each in found if each.answers > 1]
    if twins:
        raise BusFault(f"{channel}: node id {', '.join(twins)} answers twice: give every node an id of its own")
    if wrong:
        node, differs = next(iter(wrong.items()))
        raise refused_identity(joints[node], node, differs)
    return 0
