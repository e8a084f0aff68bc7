"""The drives of an arm: one group for each family on each bus, with their places in the arm."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from armlink.arm_file import ArmFile
from armlink.bus.can_bus import CanBus
from armlink.drives.base import BasicDrives
from armlink.drives.family import Family, family
from armlink.drives.traits import Traits
from armlink.errors import BadInput


@dataclass(frozen=True, eq=False)
class Group:
    family: Family
    drives: BasicDrives[Any]
    places: tuple[int, ...]
    """Joints of the arm, in order."""
    tag: int
    """Marks identifiers of its bus where there are several, else 0."""


def make_groups(arm: ArmFile, bus: CanBus | None = None) -> tuple[Group, ...]:
    """Groups of an arm on an open bus (None: all on one), SYNC's last; raises BadInput where ids clash."""
    joints = arm.require_link().joints
    tags: dict[str, int] = getattr(bus, "tags", {})
    found: dict[tuple[str, int], list[int]] = {}
    taken: dict[tuple[str, int], str] = {}
    for place, joint in enumerate(joints):
        tag = tags.get(joint.bus, 0)
        address = joint.settings.address
        other = taken.setdefault((address, tag), joint.name)
        if other != joint.name:
            where = "one bus" if bus is None else bus.channel_info
            raise BadInput(
                f"{other} and {joint.name} both have {address} on {where}: give each joint its own id on a bus"
            )
        found.setdefault((joint.settings.family, tag), []).append(place)
    groups = []
    for (name, tag), places in found.items():
        kind = family(name)
        drives = kind.build(arm, [joints[place] for place in places])
        groups.append(Group(kind, drives, tuple(places), tag))
    return tuple(sorted(groups, key=lambda group: group.family.traits.cadence == "sync"))


def by_joint(groups: Sequence[Group]) -> tuple[tuple[Group, int], ...]:
    """The group of each joint, in joint order, and the number that the joint's drive has in it."""
    found = {place: (group, number) for group in groups for number, place in enumerate(group.places)}
    return tuple(found[place] for place in sorted(found))


def traits_of(groups: Sequence[Group]) -> list[Traits]:
    return [group.drives.traits(number) for group, number in by_joint(groups)]


def state_name(arm: ArmFile, joint: int, code: int) -> str:
    """State of a joint in words, from its code in `Sample.status`."""
    return family(arm.require_link().joints[joint].settings.family).state_name(code)
