"""PDOs of all nodes, compiled from objects 1400h to 1A03h."""

import itertools
import struct
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from sim_bus.node.object_arrays import DTYPES, Key, ObjectArrays, variable

Frame = tuple[int, bytes]


def layout(mapping: tuple[int, ...]) -> np.dtype[np.void]:
    """The packed structure of a mapping; fields f0, f1, … in order. Raises KeyError on an unknown object."""
    fields = []
    for number, entry in enumerate(mapping):
        item = variable(entry >> 16, entry >> 8 & 0xFF)
        if item is None or not item.pdo_mappable or len(item) != entry & 0xFF:
            raise KeyError(f"{entry:08X}h cannot be mapped")
        fields.append((f"f{number}", DTYPES[item.data_type]))
    return np.dtype(fields)


class MappedPdo:
    """One valid PDO of one node."""

    def __init__(
        self, node: int, number: int, cob_id: int, kind: int, mapping: tuple[int, ...], signals: ObjectArrays
    ) -> None:
        """`node` is its index in the arm, `number` from 0, `kind` its transmission type, 0 to 240 synchronous,
        254 and 255 event-driven. `mapping` has entries index << 16 | sub << 8 | bits."""
        self.node, self.number, self.cob_id, self.kind = node, number, cob_id, kind
        self.packed = layout(mapping)
        self.keys: list[Key] = [(entry >> 16, entry >> 8 & 0xFF) for entry in mapping]
        self.content = b""
        """Received and not yet in the signals; of a PDO that is sent, sent last."""
        self._signals = [signals[key] for key in self.keys]
        self._struct = struct.Struct("<" + "".join(self.packed[name].char for name in self.packed.names or ()))

    def take(self) -> bool:
        """Put what was received since the last call into the signals; whether anything was."""
        if not self.content:
            return False
        for signal, value in zip(self._signals, self._struct.unpack(self.content), strict=True):
            signal[self.node] = value
        self.content = b""
        return True


class SentPdos:
    """TPDOs of nodes with one number, kind and mapping: packed together, since every cycle packs all of them."""

    def __init__(self, pdos: Sequence[MappedPdo], signals: ObjectArrays) -> None:
        first = pdos[0]
        self.pdos, self.kind, self._size = pdos, first.kind, first.packed.itemsize
        self._nodes = np.array([pdo.node for pdo in pdos])
        self._block = np.zeros(len(pdos), first.packed)
        names = first.packed.names or ()
        self._fields = [(self._block[name], signals[key]) for name, key in zip(names, first.keys, strict=True)]
        self._sent = b""

    def contents(self) -> list[bytes]:
        """Of each PDO by the signals."""
        return self._cut(self._pack())

    def changed(self, operational: bytearray) -> list[MappedPdo]:
        """PDOs of operational nodes whose content is not the one that was sent last; it is from now on."""
        packed = self._pack()
        if packed == self._sent:
            return []
        found = [
            (pdo, content)
            for pdo, content in zip(self.pdos, self._cut(packed), strict=True)
            if content != pdo.content and operational[pdo.node]
        ]
        for pdo, content in found:
            pdo.content = content
        self._sent = b"".join(pdo.content for pdo in self.pdos)
        return [pdo for pdo, _ in found]

    def _pack(self) -> bytes:
        for field, signal in self._fields:
            field[:] = signal[self._nodes]
        return self._block.tobytes()

    def _cut(self, packed: bytes) -> list[bytes]:
        return [packed[place : place + self._size] for place in range(0, len(packed), self._size)]


class PdoTable:
    """All PDOs of the arm; `receive` by COB-ID."""

    def __init__(self, signals: ObjectArrays, operational: bytearray, outbox: Callable[[Frame], None]) -> None:
        """`operational[j]`: whether node j may use PDOs; frames go to `outbox`."""
        self._signals, self._operational, self._outbox = signals, operational, outbox
        self.compile((), ())

    def compile(self, receive: Iterable[MappedPdo], send: Iterable[MappedPdo]) -> None:
        """Rebuild the table from all valid PDOs of all nodes."""
        receive, send = (sorted(each, key=lambda pdo: (pdo.number, pdo.node)) for each in (receive, send))
        self.receive = {pdo.cob_id: pdo for pdo in receive}
        self.sync_receive = [pdo for pdo in receive if pdo.kind <= 240]
        groups = [
            SentPdos(list(pdos), self._signals)
            for _, pdos in itertools.groupby(send, lambda pdo: (pdo.number, pdo.kind, pdo.keys))
        ]
        self._sync_send = [group for group in groups if group.kind <= 240]
        self._event_send = [group for group in groups if group.kind >= 254]
        self._count = 0

    def send_sync(self) -> None:
        self._count += 1
        for group in self._sync_send:
            if self._count % max(group.kind, 1) == 0:
                for pdo, content in zip(group.pdos, group.contents(), strict=True):
                    if self._operational[pdo.node]:
                        self._outbox((pdo.cob_id, content))

    def send_events(self) -> None:
        """Send event-driven TPDOs with changed content."""
        for group in self._event_send:
            for pdo in group.changed(self._operational):
                self._outbox((pdo.cob_id, pdo.content))
