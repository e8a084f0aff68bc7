"""Port on a raw SocketCAN socket: classical frames, or CAN FD frames with bit-rate switch."""

import socket
import struct
from collections.abc import Sequence

from armlink.bus.port import CLASSICAL, ERROR, REMOTE, Frame
from armlink.bus.sockets.datagram_port import DatagramBatch, DatagramPort

_CLASSIC, _FD = struct.Struct("=IBB2x8s"), struct.Struct("=IBB2x64s")
_NEVER_FD, _ON_WIRE = ERROR | REMOTE | CLASSICAL, 0xFFFFFFFF
_FD_FLAGS = 0x05  # CANFD_BRS | CANFD_FDF: a CAN FD frame with bit-rate switch


class SocketPort(DatagramPort):
    def __init__(self, raw: socket.socket, name: str, fd: bool = False, as_node: bool = False) -> None:
        """`name` of the bus for messages; `fd`: the socket accepts CAN FD frames, and CAN FD frames are sent.

        `as_node` as in CanBus.open_port.
        """
        self._layout = _FD if fd else _CLASSIC
        size = self._layout.size
        super().__init__(name, raw, raw, DatagramBatch(size), DatagramBatch(size), as_node)
        self._received = memoryview(self._in.content)
        self._fd = fd

    def _encode(self, frames: Sequence[Frame]) -> None:
        if self._layout is _FD:
            for i, (can_id, data) in enumerate(frames):
                layout, flags = (_CLASSIC, 0) if can_id & _NEVER_FD or not self._fd else (_FD, _FD_FLAGS)
                self._out.put(i, layout.pack(can_id & _ON_WIRE, len(data), flags, data))
            return
        content, pack, size = self._out.content, self._layout.pack_into, self._layout.size
        for i, (can_id, data) in enumerate(frames):
            pack(content, i * size, can_id & _ON_WIRE, len(data), 0, data)

    def _decode(self, count: int) -> list[Frame]:
        layout = self._layout
        if self._as_node and layout is _FD:
            self._fd = self._in.messages[count - 1].length == layout.size
        frames = layout.iter_unpack(self._received[: count * layout.size])
        return [(can_id, data[:length]) for can_id, length, _, data in frames]
