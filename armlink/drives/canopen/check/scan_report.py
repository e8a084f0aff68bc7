"""Nodes on a CANopen bus as `armlink scan` shows them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from armlink.arm_file import ArmFile, Bus
from armlink.bus.bus_group import BusGroup, GroupPort
from armlink.bus.open import open_bus, open_link_bus
from armlink.bus.port import BUS_SHIFT
from armlink.clock import MonotonicClock
from armlink.drives.canopen.check.scan import describe_type, scan_bus
from armlink.drives.canopen.controller_setup import identity_mismatches, refused_identity
from armlink.drives.canopen.eds_file import expected_identity, of_joints
from armlink.errors import BusFault


def scan_report(
    arm: ArmFile | None,
    bus: str | None,
    json: Path | None,
    write: Callable[[Path | None, Any], None],
    show: Callable[..., None],
) -> int:
    """Find every node of a bus and those of an arm, `show` them, `write` them as JSON; exit status.

    Raises BusFault for a joint that does not answer, Refused for another controller than the arm file states.
    """
    if arm is None:
        joints, stated = {}, {}
        opened = open_bus(bus, Bus())
    else:
        link = arm.require_link()
        sheets = of_joints(arm, link.joints)
        joints = {joint.settings.node: joint.name for joint in link.joints}
        stated = {
            each.settings.node: expected_identity(each, sheet) for each, sheet in zip(link.joints, sheets, strict=True)
        }
        opened = open_link_bus(bus, link)
    try:
        clock = opened.clock or MonotonicClock()
        port = opened.open_port()
        found = []
        for place, member in enumerate(port.members if isinstance(port, GroupPort) else (port,)):
            named = [] if arm is None else arm.require_link().joints
            if isinstance(opened, BusGroup):
                named = [joint for joint in named if opened.tags[joint.bus] >> BUS_SHIFT == place]
            stock = {joint.settings.node for joint in named if joint.settings.torque != "record"}
            found += scan_bus(member, clock, {joint.settings.node: joint.name for joint in named}, stock)
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
            table.add_row(str(each.node), each.joint, Text("no answer", style="red"))
    show(table if found else f"{channel}: no node answers")
    for lost in dict.fromkeys(lost for each in found for lost in each.lost):
        lacking = [each.joint for each in found if lost in each.lost]
        show(f"{', '.join(lacking)} {'lacks' if len(lacking) == 1 else 'lack'} {lost}")
    nodes = [{**vars(each), "state": each.state.value, "mismatches": wrong.get(each.node, [])} for each in found]
    write(json, {"bus": channel, "nodes": nodes})
    missing = [f"{each.joint} (node {each.node})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}")
    twins = [str(each.node) for each in found if each.answers > 1]
    if twins:
        raise BusFault(f"{channel}: node id {', '.join(twins)} answers twice: give every node an id of its own")
    if wrong:
        node, differs = next(iter(wrong.items()))
        raise refused_identity(joints[node], node, differs)
    if found:
        show(f"{len(found)} nodes answer")
    return 0
