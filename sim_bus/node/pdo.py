"""PDOs of all nodes, compiled from objects 1400h to 1A03h."""

import struct
from collections.abc import Callable, Iterable

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

    def pack(self) -> bytes:
        return self._struct.pack(*[signal.item(self.node) for signal in self._signals])


class PdoTable:
    """All PDOs of the arm; `receive` by COB-ID."""

    def __init__(self, operational: bytearray, outbox: Callable[[Frame], None]) -> None:
        """`operational[j]`: whether node j may use PDOs; frames go to `outbox`."""
        self._operational, self._outbox = operational, outbox
        self.compile((), ())

    def compile(self, receive: Iterable[MappedPdo], send: Iterable[MappedPdo]) -> None:
        """Rebuild the table from all valid PDOs of all nodes."""
        receive, send = (sorted(each, key=lambda pdo: (pdo.number, pdo.node)) for each in (receive, send))
        self.receive = {pdo.cob_id: pdo for pdo in receive}
        self.sync_receive = [pdo for pdo in receive if pdo.kind <= 240]
        self._sync_send = [pdo for pdo in send if pdo.kind <= 240]
        self._event_send = [pdo for pdo in send if pdo.kind >= 254]
        self._count = 0

    def send_sync(self) -> None:
        self._count += 1
        for pdo in self._sync_send:
            if self._count % max(pdo.kind, 1) == 0 and self._operational[pdo.node]:
                self._outbox((pdo.cob_id, pdo.pack()))

    def send_events(self) -> None:
        """Send event-driven TPDOs with changed content."""
        for pdo in self._event_send:
            if self._operational[pdo.node] and (content := pdo.pack()) != pdo.content:
                pdo.content = content
                self._outbox((pdo.cob_id, content))
