"""Discovery: the drives on a bus that no arm file describes, by frames that only read.

What reads in one family can command in another: on 7FFh a register request to a Damiao drive writes the mode of every
moteus controller, and sends an ODrive that has no node id yet into its boot loader. So the bus is heard first, and a
family is asked after those whose drives its requests could command, and only where none of these is there.
"""

from collections.abc import Sequence
from dataclasses import replace
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from armlink.arm_file import parse_arm
from armlink.bus.can_bus import CanBus
from armlink.drives.family import family, family_names
from armlink.drives.findings import FoundDrive, FoundDrives
from armlink.drives.orders import DriveIdentity
from armlink.drives.searched_bus import SearchedBus
from armlink.errors import BusFault


class AskedDrives:
    """Drives of one family that were found by their ids; what else they tell is asked as of the joints of an arm.

    One that no arm file can name is listed and not asked.
    """

    def __init__(self, bus: SearchedBus, found: Sequence[FoundDrive]) -> None:
        self._bus = bus
        self.nodes = [_node(each, DriveIdentity(0, each.address, True)) for each in found if each.drive is None]
        self.found = [each for each in found if each.drive is not None]
        if not self.found:
            return
        limits = {"rated_torque": 1.0, "max_torque": 1.0}
        joints = [{"name": each.address, **each.keys, **limits} for each in self.found]
        rows = [{"name": each.address, "lower": -1.0, "upper": 1.0} for each in self.found]
        link = {"bus": {"fd": bus.fd}, "joints": joints}
        arm = parse_arm({"name": "found", "kinematics": {"joints": rows}, "link": link}, Path(bus.channel_info))
        self._drives = family(found[0].family).build(arm, arm.require_link().joints)
        bus.take = self._drives.take
        told = self._drives.identify(bus)
        self.nodes += map(_node, self.found, told)
        self.found = [replace(drive, serial=each.serial) for drive, each in zip(self.found, told, strict=True)]

    def positions(self) -> dict[str, float]:
        self._bus.take = self._drives.take
        self._bus.catch_up()
        found = dict(zip((each.address for each in self.found), self._drives.positions(self._bus), strict=True))
        silent = [address for address, position in found.items() if position != position]
        if silent:
            raise BusFault(f"{self._bus.channel_info}: {', '.join(silent)}: no output position is reported")
        return found


def _node(drive: FoundDrive, identity: DriveIdentity) -> dict[str, Any]:
    """A drive in the answer of a scan: as `armlink scan ARM` has it, and what was found."""
    power, traits = identity.power.value, family(drive.family).traits.as_json()
    usual = {**vars(identity), "joint": "", "family": drive.family, "power": power, "traits": traits}
    found = {"reply": drive.reply, "model": drive.model, "answers": drive.answers}
    return usual | found | {"wrong": drive.wrong, "note": drive.note}


class BusDrives:
    """The drives of all families that are found on a bus."""

    def __init__(self, bus: CanBus) -> None:
        """Search the bus; nothing but frames that read is sent."""
        searched = SearchedBus(bus)
        found = {name: family(name).discovery for name in family_names() if not family(name).traits.heard}
        ways = {name: way for name, way in found.items() if way is not None}
        self.parts: list[FoundDrives] = []
        asked = list[str]()
        lacking = {"found only by the ids in an arm file": sorted(found.keys() - ways)}
        order = TopologicalSorter({name: way.spares for name, way in ways.items()}).static_order()
        for name in filter(ways.__contains__, order):
            way, lack = ways[name], ""
            if family(name).traits.frame == "fd" and not searched.fd:
                lack = "the bus is classical CAN; CAN FD needs --bus INTERFACE:CHANNEL@1000000/5000000"
            if beside := {node["family"] for node in self.nodes}.intersection(way.spares):
                lack = f"requests to them could command the {beside.pop()} drives, or look like their frames"
            if lack:
                lacking.setdefault(lack, []).append(name)
                continue
            asked.append(name)
            part = way.find(searched)
            self.parts.append(AskedDrives(searched, part) if isinstance(part, Sequence) else part)
        others = [f"{', '.join(names)} ({lack})" for lack, names in lacking.items() if names]
        self.told = f"looked for {', '.join(sorted(asked))}" + (f"; not for {', '.join(others)}" if others else "")
        self._channel = searched.channel_info

    @property
    def nodes(self) -> list[dict[str, Any]]:
        """All that answer, as a scan shows them."""
        return [node for part in self.parts for node in part.nodes]

    @property
    def found(self) -> list[FoundDrive]:
        """Those that an arm file can name; raises BusFault where two have the same id."""
        self.require_own_ids()
        return [drive for part in self.parts for drive in part.found]

    def require_own_ids(self) -> None:
        twins = ", ".join(str(node["address"]) for node in self.nodes if node["answers"] > 1)
        if twins:
            raise BusFault(f"{self._channel}: {twins} answers twice: give every drive its own id")

    def positions(self) -> dict[str, float]:
        return {key: each for part in self.parts if part.found for key, each in part.positions().items()}
