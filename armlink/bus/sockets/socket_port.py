"""Port on a raw SocketCAN socket: classical frames, or CAN FD frames with bit-rate switch."""

import socket
import struct
from typing import Any

from armlink.bus.port import CLASSICAL, ERROR, REMOTE, Frame
from armlink.bus.sockets.datagram_port import DatagramPort

_CLASSIC, _FD = struct.Struct("=IBB2x8s"), struct.Struct("=IBB2x64s")
_NEVER_FD, _ON_WIRE = ERROR | REMOTE | CLASSICAL, 0xFFFFFFFF
_FD_FLAGS = 0x05  # CANFD_BRS | CANFD_FDF: a CAN FD frame with bit-rate switch


class SocketPort(DatagramPort):
    longest = _FD.size

    def __init__(
        self, raw: socket.socket, name: str, fd: bool = False, as_node: bool = False, stamped: bool = False
    ) -> None:
        """`fd`: the socket accepts CAN FD frames, and CAN FD frames are sent; the rest as of DatagramPort."""
        super().__init__(name, raw, raw, as_node, stamped)
        self._fd, self._receive = fd, raw.recv

    def _encode(self, can_id: int, data: bytes) -> bytes:
        layout, flags = (_FD, _FD_FLAGS) if self._fd and not can_id & _NEVER_FD else (_CLASSIC, 0)
        return layout.pack(can_id & _ON_WIRE, len(data), flags, data)

    def _take(self) -> Frame | None:
        return self._decoded(self._receive(_FD.size, socket.MSG_DONTWAIT))

    def _decoded(self, datagram: bytes, sender: Any = None) -> Frame:
        layout = _FD if len(datagram) == _FD.size else _CLASSIC
        if self._as_node:
            self._fd = layout is _FD
        can_id, length, _, data = layout.unpack(datagram)
        return can_id, data[:length]
