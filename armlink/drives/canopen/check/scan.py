"""Nodes on a CANopen bus: a search, `armlink scan`, and how they differ from an arm file; reads only."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from armlink.arm_file import ArmFile
from armlink.bus.bus_group import BusGroup, GroupPort
from armlink.bus.can_bus import CanBus
from armlink.bus.open import open_link_bus
from armlink.bus.port import BUS_SHIFT
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.controller_setup import Identity, identify, identity_mismatches, refused_identity
from armlink.drives.canopen.eds_file import bundled, expected_identity, of_joints
from armlink.drives.canopen.object_dictionary import SDO_REQUEST_ID, SDO_RESPONSE_ID
from armlink.drives.canopen.profile import Profile, lacking_objects
from armlink.drives.canopen.sdo import NodeServices, PumpedNetwork
from armlink.drives.canopen.units import RATED_TORQUE_TOLERANCE, told_units
from armlink.drives.findings import FoundDrive, SetupFinding
from armlink.drives.searched_bus import SearchedBus
from armlink.errors import BusFault

_READ_DEVICE_TYPE = b"\x40" + objects.DEVICE_TYPE.address + bytes(4)


def sdo_network(bus: SearchedBus) -> PumpedNetwork:
    """A network for SDO reads, whose answers `bus.wait` waits for."""
    network = PumpedNetwork(bus.send)
    bus.take = lambda can_id, data, now: network.notify(can_id, bytearray(data), now)
    return network


def scan_bus(bus: SearchedBus, joints: Mapping[int, str], stock: Collection[int] = ()) -> list[Identity]:
    """Every node that answers a read of its device type, and the nodes of `joints` (node id → joint name) that do not.

    Nodes of `stock` are asked for the optional objects of the profile, too. Sorted by node id. Raises BusFault if one
    that answered stops answering.
    """
    found, network, dictionary = _search(bus), sdo_network(bus), bundled()
    identities = []
    for node in sorted({*+found, *joints}):
        name = joints.get(node, "")
        if found[node] > 1:  # both nodes would answer every request
            identities.append(Identity(name, node, present=True, answers=found[node]))
        elif found[node]:
            services = NodeServices(network, name, node, dictionary, bus.wait)
            lost = Profile(absent=lacking_objects(services)).lost if node in stock else ()
            identities.append(replace(identify(services), lost=lost))
        else:
            identities.append(Identity(name, node, present=False))
    return identities


def _search(bus: SearchedBus) -> Counter[int]:
    """Node id → number of responses to one request."""
    heard = bus.gather([(SDO_REQUEST_ID + node, _READ_DEVICE_TYPE) for node in range(1, 128)])
    asked = objects.DEVICE_TYPE.address
    answers = [can_id - SDO_RESPONSE_ID for can_id, data in heard if len(data) == 8 and data[1:4] == asked]
    return Counter(node for node in answers if 0 < node < 128)


def describe_type(device_type: int) -> str:
    """Device profile of 1000h as text, for example `CiA 402 servo drive`."""
    profile = device_type & 0xFFFF
    kind = {0x0001: "frequency converter", 0x0002: "servo drive", 0x0004: "stepper"}.get(device_type >> 16 & 0xFF, "")
    return f"CiA {profile} {kind}".strip() if profile else "no profile"


def _require_own_ids(found: Collection[Identity], channel: str) -> None:
    twins = [str(each.node) for each in found if each.answers > 1]
    if twins:
        raise BusFault(f"{channel}: node id {', '.join(twins)} answers twice: give every node its own id")


class FoundNodes:
    """The drives of a bus, by node id."""

    def __init__(self, bus: SearchedBus) -> None:
        """Search the bus; raises BusFault naming the node."""
        self._bus = bus
        self.identities = {each.node: each for each in scan_bus(bus, {})}
        network, sheet = sdo_network(bus), bundled()
        self._services = {
            node: NodeServices(network, f"node {node}", node, sheet, bus.wait) for node in self.identities
        }
        self._take = bus.take

    @property
    def nodes(self) -> list[dict[str, Any]]:
        usual = {"reply": None, "model": "", "wrong": "", "note": "", "firmware": ""}
        return [
            usual | _answer(each, []) | {"address": f"node {each.node}", "power": each.state.value}
            for each in self.identities.values()
        ]

    @cached_property
    def found(self) -> list[FoundDrive]:
        """As every drive describes itself; raises BusFault naming the node."""
        _require_own_ids(self.identities.values(), self._bus.channel_info)
        self._bus.take = self._take
        return [self._read(each) for each in self.identities.values()]

    def positions(self) -> dict[str, float]:
        services, found = self._services, self.found
        self._bus.take = self._take
        return {each.address: int(services[each.node].read(objects.POSITION)) * each.unit for each in found}

    def _read(self, identity: Identity) -> FoundDrive:
        services = self._services[identity.node]
        rated = int(services.read(objects.RATED_TORQUE))
        try:
            units = told_units(services, rated)
        except ValueError as error:
            raise BusFault(
                f"node {identity.node}: its units cannot be read ({error}): set up the drive first"
            ) from None
        most = int(services.read(objects.MAX_TORQUE)) * units.torque
        own = services.has(objects.TORQUE_READING)
        keys = None if own else {"node": identity.node, "torque": "motor", "calibration": "host"}
        ids = identity.node, f"node {identity.node}", keys, identity.vendor, identity.product
        return FoundDrive("canopen", *ids, rated * 1e-3, most, units.position, serial=str(identity.serial or ""))


def arm_findings(arm_file: ArmFile, opened: CanBus, bus: str) -> Iterator[SetupFinding]:
    """Findings about the drives of an arm on an open bus of this name; raises BusFault."""
    link, drives = arm_file.require_link(), FoundNodes(SearchedBus(opened, opened.open_port()))
    by_node, ours = {each.node: each for each in drives.found}, {joint.settings.node for joint in link.joints}
    spare = [each.node for each in drives.found if each.node not in ours]
    unknown = f"; nodes {', '.join(map(str, spare))} answer but belong to no joint" if spare else ""
    for joint, sheet in zip(link.joints, of_joints(arm_file, link.joints), strict=True):
        node = joint.settings.node
        where, drive = f"{joint.name} (node {node})", by_node.get(node)
        if drive is None:
            find = f"armlink new {arm_file.argument} --bus {bus} --out found.yaml"
            remedy = f"check its power, wiring and node id{unknown}; to find the drives: {find}"
            yield SetupFinding("error", f"no answer on {bus}", where, remedy)
            continue
        for differs in identity_mismatches(expected_identity(joint, sheet), vars(drives.identities[node])):
            remedy = "connect the right arm, or correct identity under link.joints"
            yield SetupFinding("error", f"not the drive in the arm file: {differs}", where, remedy)
        if abs(drive.rated_torque - joint.rated_torque) > RATED_TORQUE_TOLERANCE * joint.rated_torque:
            what = (
                f"the rated torque of the drive (6076h) is {drive.rated_torque:g} N·m, but the arm file has "
                f"{joint.rated_torque:g}"
            )
            remedy = f"write `rated_torque: {drive.rated_torque:g}` in the arm file, or connect the right drive"
            yield SetupFinding("error", what, where, remedy)
        if drive.max_torque < joint.max_torque * (1 - RATED_TORQUE_TOLERANCE):
            what = f"the drive allows {drive.max_torque:g} N·m (6072h), but max_torque is {joint.max_torque:g} N·m"
            remedy = f"lower max_torque to {drive.max_torque:g} in the arm file, or raise the drive's own limit (6072h)"
            yield SetupFinding("warning", what, where, remedy)
    if spare and len(drives.found) - len(spare) == len(link.joints):
        what = f"nodes {', '.join(map(str, spare))} answer but belong to no joint"
        yield SetupFinding("hint", what, bus, "they may be a gripper or another arm: nothing is sent to them")


def scan_report(
    arm: ArmFile,
    bus: str | None,
    json: Path | None,
    write: Callable[[Path | None, Any], None],
    show: Callable[..., None],
) -> int:
    """Find every node of an arm's bus, `show` them, `write` them as JSON; exit status.

    Raises BusFault for a joint that does not answer, Refused for another controller than the arm file states.
    """
    link = arm.require_link()
    sheets = of_joints(arm, link.joints)
    joints = {joint.settings.node: joint.name for joint in link.joints}
    stated = {
        each.settings.node: expected_identity(each, sheet) for each, sheet in zip(link.joints, sheets, strict=True)
    }
    opened = open_link_bus(bus, link)
    try:
        port = opened.open_port()
        found = []
        for place, member in enumerate(port.members if isinstance(port, GroupPort) else (port,)):
            named = list(link.joints)
            if isinstance(opened, BusGroup):
                named = [joint for joint in named if opened.tags[joint.bus] >> BUS_SHIFT == place]
            stock = {joint.settings.node for joint in named if joint.settings.torque != "record"}
            found += scan_bus(SearchedBus(opened, member), {joint.settings.node: joint.name for joint in named}, stock)
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
    show(table)
    if any(each.present for each in found):
        show("identity: vendor:product:revision, hexadecimal, as the drive states it (1018h)")
    for lost in dict.fromkeys(lost for each in found for lost in each.lost):
        lacking = [each.joint for each in found if lost in each.lost]
        show(f"{', '.join(lacking)} {'lacks' if len(lacking) == 1 else 'lack'} {lost}")
    write(json, {"bus": channel, "nodes": [_answer(each, wrong.get(each.node, [])) for each in found]})
    missing = [f"{each.joint} (node {each.node})" for each in found if not each.present]
    if missing:
        raise BusFault(f"no answer from {', '.join(missing)} on {channel}: check power, wiring and ids")
    _require_own_ids(found, channel)
    if wrong:
        node, differs = next(iter(wrong.items()))
        raise refused_identity(joints[node], node, differs)
    show(f"{len(found)} nodes answer")
    return 0


def _answer(each: Identity, mismatches: Sequence[str]) -> dict[str, Any]:
    return {**vars(each), "family": "canopen", "state": each.state.value, "mismatches": mismatches}
