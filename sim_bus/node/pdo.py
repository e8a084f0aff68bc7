"""PDOs of all nodes, compiled from objects 1400h to 1A03h; nodes with equal mappings share a packed array."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armlink.drives.canopen.pdo import INVALID
from sim_bus.node.object_arrays import DTYPES, Key, ObjectArrays, variable

Frame = tuple[int, bytes]


@dataclass(frozen=True)
class PdoParameters:
    """One PDO of one node, from its objects."""

    node: int
    """Index of the node in the arm."""
    number: int
    """Number of the PDO, from 0."""
    cob_id: int
    kind: int
    """Transmission type: 0 to 240 synchronous, 254 and 255 event-driven."""
    mapping: tuple[int, ...]
    """Entries index << 16 | sub << 8 | bits."""


def layout(mapping: tuple[int, ...]) -> np.dtype[np.void]:
    """The packed structure of a mapping; fields f0, f1, … in order. Raises KeyError on an unknown object."""
    fields = []
    for number, entry in enumerate(mapping):
        item = variable(entry >> 16, entry >> 8 & 0xFF)
        if item is None or not item.pdo_mappable or len(item) != entry & 0xFF:
            raise KeyError(f"{entry:08X}h cannot be mapped")
        fields.append((f"f{number}", DTYPES[item.data_type]))
    return np.dtype(fields)


class PdoGroup:
    """PDOs of one kind, number and mapping over several nodes."""

    def __init__(self, members: list[PdoParameters], signals: ObjectArrays) -> None:
        """Lay out the members' data one after the other."""
        self.kind, self.number = members[0].kind, members[0].number
        self.cob_ids = [member.cob_id for member in members]
        self.nodes = [member.node for member in members]
        packed = layout(members[0].mapping)
        self.size = packed.itemsize
        self.buffer = bytearray(self.size * len(members))
        view = np.frombuffer(self.buffer, packed)
        keys: list[Key] = [(entry >> 16, entry >> 8 & 0xFF) for entry in members[0].mapping]
        self.keys = set(keys)
        self.fields = [(view[f"f{number}"], signals[key]) for number, key in enumerate(keys)]
        n = len(self.fields[0][1]) if self.fields else 0
        self.whole = self.nodes == list(range(n))
        self.rows = np.array(self.nodes)
        self.fresh = bytearray(len(members))
        self.sent = [b""] * len(members)
        self.settled = b""
        """Packed data when every member had last sent."""
        self._all_fresh = bytearray(b"\1" * len(members))
        self._none_fresh = bytes(len(members))

    def take(self) -> NDArray[np.intp] | None:
        """Copy data received since the last call into the signals; returns the nodes, or None."""
        if self.fresh == self._none_fresh:
            return None
        if self.whole and self.fresh == self._all_fresh:
            for field, signal in self.fields:
                signal[:] = field
            rows = self.rows
        else:
            mask = np.frombuffer(self.fresh, np.uint8).astype(bool)
            rows = self.rows[mask]
            for field, signal in self.fields:
                signal[rows] = field[mask]
        self.fresh[:] = self._none_fresh
        return rows

    def pack(self) -> bytes:
        for field, signal in self.fields:
            field[:] = signal if self.whole else signal[self.rows]
        return bytes(self.buffer)


class PdoTable:
    """All PDOs of the arm. `receive` maps a COB-ID to (group, place)."""

    def __init__(self, signals: ObjectArrays, operational: bytearray, outbox: Callable[[Frame], None]) -> None:
        """`operational[j]`: whether node j may use PDOs; frames go to `outbox`."""
        self._signals, self._operational, self._outbox = signals, operational, outbox
        self.receive: dict[int, tuple[PdoGroup, int]] = {}
        self.sync_receive: list[PdoGroup] = []
        self._sync_send: list[PdoGroup] = []
        self._event_send: list[PdoGroup] = []
        self._count = 0

    def compile(self, receive: list[PdoParameters], send: list[PdoParameters]) -> None:
        """Rebuild the table from all valid PDOs of all nodes."""
        groups = _grouped(receive, self._signals)
        self.receive = {cob: (group, place) for group in groups for place, cob in enumerate(group.cob_ids)}
        self.sync_receive = [group for group in groups if group.kind <= 240]
        groups = _grouped(send, self._signals)
        self._sync_send = [group for group in groups if group.kind <= 240]
        self._event_send = [group for group in groups if group.kind >= 254]
        self._count = 0

    def send_sync(self) -> None:
        self._count += 1
        for group in self._sync_send:
            if self._count % max(group.kind, 1) == 0:
                data, size = group.pack(), group.size
                for place, cob_id in enumerate(group.cob_ids):
                    if self._operational[group.nodes[place]]:
                        self._outbox((cob_id, data[place * size : (place + 1) * size]))

    def send_events(self) -> None:
        """Send event-driven TPDOs with changed content."""
        for group in self._event_send:
            data, size = group.pack(), group.size
            if data == group.settled:
                continue
            group.settled = data if all(self._operational[node] for node in group.nodes) else b""
            for place, cob_id in enumerate(group.cob_ids):
                content = data[place * size : (place + 1) * size]
                if content != group.sent[place] and self._operational[group.nodes[place]]:
                    group.sent[place] = content
                    self._outbox((cob_id, content))


def _grouped(pdos: list[PdoParameters], signals: ObjectArrays) -> list[PdoGroup]:
    groups: dict[tuple[int, int, tuple[int, ...]], list[PdoParameters]] = defaultdict(list)
    for pdo in sorted(pdos, key=lambda pdo: (pdo.number, pdo.node)):
        if pdo.mapping and not pdo.cob_id & INVALID:
            groups[pdo.number, pdo.kind, pdo.mapping].append(pdo)
    return [PdoGroup(members, signals) for members in groups.values()]
