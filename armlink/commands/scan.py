"""Nodes on the bus with their identity and state; writes nothing to them."""

from pathlib import Path
from typing import Annotated

import typer


def scan(
    arm: Annotated[str | None, typer.Argument(help="Bundled arm or path of an arm file; without: all nodes.")] = None,
    bus: Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the answer here; - is standard output.")] = None,
) -> int:
    """List the nodes that answer on a bus; with an arm file also those of its joints that do not (exit status 3).

    Example: armlink scan sarcos --bus socketcan:vcan0
    """
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from armlink.armfile import load_arm
    from armlink.bus import open_bus
    from armlink.clock import MonotonicClock
    from armlink.commands.output import write_json
    from armlink.errors import BadInput, BusFault
    from armlink.port import open_port
    from armlink.scan import describe_type, scan_bus

    if arm is None and bus is None:
        raise BadInput("scan: give an arm file, or --bus INTERFACE:CHANNEL[@BITRATE]")
    if arm is None:
        from armlink.armfile import Bus

        joints, section = {}, Bus()
    else:
        link = load_arm(arm).require_link()
        joints, section = {joint.node: joint.name for joint in link.joints}, link.bus
    opened = open_bus(bus, section)
    try:
        clock = getattr(opened, "clock", None) or MonotonicClock()
        found = scan_bus(open_port(opened), clock, joints)
        channel = str(opened.channel_info)
    finally:
        opened.shutdown()
    table = Table("node", "joint", "state", "device", "identity", "serial", box=SIMPLE, title=channel)
    for each in found:
        if each.present:
            told = (each.state.value, each.name or describe_type(each.device_type))
            identity = f"{each.vendor:x}:{each.product:x}:{each.revision:x}"
            table.add_row(str(each.node), each.joint, *told, identity, str(each.serial))
        else:
            table.add_row(str(each.node), each.joint, "[red]no answer[/red]")
    Console(stderr=True).print(table if found else f"{channel}: no node answers")
    write_json(json, {"bus": channel, "nodes": [{**vars(each), "state": each.state.value} for each in found]})
    missing = [f"{each.joint} (node {each.node})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}")
    return 0
