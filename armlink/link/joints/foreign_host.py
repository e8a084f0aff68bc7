"""Commands of another host on the bus, and the beginnings of its cycles: for listening without sending anything."""

from collections.abc import Sequence

import numpy as np

from armlink.arrays import Array
from armlink.bus.port import BUS_SHIFT, Frame
from armlink.drives.base import ANY
from armlink.drives.orders import Order, law_torque
from armlink.link.joints.groups import Group
from armlink.link.joints.values import JointValues
from armlink.link.types import Sample

Commands = tuple[Frame, ...]


class ForeignHost:
    """Follows the commands of another host for n joints."""

    def __init__(self, groups: Sequence[Group], values: JointValues, forgets: bool = False) -> None:
        """The drives of an arm on their buses; `values` turns values of drives into those of joints.

        `forgets`: a command counts for one cycle; otherwise until the next to its joint.
        """
        self._forgets = forgets
        self._values, self._n = values, sum([len(group.places) for group in groups])
        syncs = [can_id | group.tag for group in groups for can_id in group.drives.cycle_ids()]
        self._sync = min(syncs, default=None)
        """SYNC of the first bus that has one begins a cycle."""
        self._ignored = frozenset(syncs)
        self._group_of = {
            can_id | group.tag: group
            for group in groups
            for can_id in group.drives.commands()
            if can_id not in group.drives.cycle_ids()
        }
        self._unnamed = [group for group in groups if ANY in group.drives.routes()]
        self._leader: int | None = None
        """Without SYNC, the joint whose command begins a cycle: the first that was heard."""
        self._newest: dict[int, Frame] = {}
        self._given: Commands = ()
        """With SYNC: the commands that it put into force."""
        self.ended: Commands = ()
        """Commands of the cycle that ended when one last began: with SYNC those before it, else those within it."""

    def begins(self, can_id: int, data: bytes) -> bool:
        """Take a frame that no drive sends; whether a cycle begins with it."""
        if can_id in self._ignored:
            if can_id == self._sync:
                self._next_cycle()
            return can_id == self._sync
        group = self._group_of.get(can_id)
        groups = self._unnamed if group is None else (group,)
        for each in groups:
            if can_id >> BUS_SHIFT != each.tag >> BUS_SHIFT:
                continue
            if self._sync is not None and group is not None:
                self._newest[can_id] = can_id, data
                return False
            found = each.drives.commands_of(can_id & ~each.tag, data)
            if found and found[0][0] >= 0:
                place = each.places[found[0][0]]
                begins = self._sync is None and self._leader in (None, place)
                self._leader = place if self._leader is None else self._leader
                if begins:
                    self._next_cycle()
                self._newest[-1 - place] = can_id, data
                return begins
        return False

    def _next_cycle(self) -> None:
        newest = tuple(self._newest.values())
        self.ended, self._given = (newest, ()) if self._sync is None else (self._given, newest)
        if self._forgets:
            self._newest.clear()

    def decode(self, commands: Commands, sample: Sample | None) -> tuple[Array, Array]:
        """Commanded torque [N·m] and target position [rad] (n,) of command frames; NaN for a joint without.

        Of a drive with gains the torque is that of its law at the readings of `sample`.
        """
        torque, position = np.full((2, self._n), np.nan)
        for joint, order in enumerate(self.orders(commands)):
            if order is not None:
                position[joint] = order.position
                if sample is not None:
                    torque[joint] = law_torque(order, float(sample.position[joint]), float(sample.velocity[joint]))
        return torque, position

    def orders(self, commands: Commands) -> list[Order | None]:
        """Orders of command frames at the joints (n,); None for a joint without."""
        ordered: list[Order | None] = [None] * self._n
        for can_id, data in commands:
            group = self._group_of.get(can_id)
            for each in self._unnamed if group is None else (group,):
                found = each.drives.commands_of(can_id & ~each.tag, data)
                for number, order in found:
                    for joint in range(len(each.places)) if number < 0 else (number,):
                        place = each.places[joint]
                        ordered[place] = self._values.ordered(place, order)
                if found:
                    break
        return ordered
