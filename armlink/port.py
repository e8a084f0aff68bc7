"""The one owner of the bus: raw frames out and in, by the fastest way that the interface offers, counted."""

import errno
import select
import struct
from collections.abc import Callable
from typing import Any, Protocol

import can

from armlink.errors import BusFault

Frame = tuple[int, bytes]

_CAN_FRAME = struct.Struct("=IB3x8s")
_FLAGS = 0xE0000000  # extended, remote, error
_ERROR_FLAG, _BUS_OFF = 0x20000000, 0x40
_RECEIVE_BUFFER = 1 << 20
_RETRY = 0.002  # [s] between tries while the transmit queue is full
_TRIES = 25


class Port(Protocol):
    """Frames with 11-bit identifiers; error frames are counted, the others that are not ours are dropped."""

    errors: int

    @property
    def send(self) -> Callable[[int, bytes], None]:
        """Sends one frame; raises BusFault where the interface cannot take it."""
        ...

    @property
    def receive(self) -> Callable[[float], Frame | None]:
        """The next frame, or None after so many seconds without one (0: what is there already)."""
        ...


def open_port(bus: Any) -> Port:
    """Wrap a python-can bus: lock-step bus (`put`, `take`), SocketCAN's own socket, or python-can messages."""
    if hasattr(bus, "take"):
        return LockStepPort(bus)
    if type(bus).__name__ == "SocketcanBus":
        return SocketPort(bus)
    return MessagePort(bus)


class LockStepPort:
    """In-process bus that never blocks (`put`, `take`); waiting lets simulated time go on."""

    def __init__(self, bus: Any) -> None:
        self.errors = 0
        self.send: Callable[[int, bytes], None] = bus.put
        self.receive: Callable[[float], Frame | None] = bus.take


class SocketPort:
    """SocketCAN without a message object a frame: struct and the raw socket."""

    def __init__(self, bus: Any) -> None:
        import socket

        self.errors = 0
        self._bus = bus
        self._socket: socket.socket = bus.socket
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._now = socket.MSG_DONTWAIT

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; a full transmit queue is tried again for some milliseconds, then BusFault."""
        frame = _CAN_FRAME.pack(can_id, len(data), data)
        for _ in range(_TRIES):
            try:
                self._socket.send(frame)
                return
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise BusFault(f"bus {self._bus.channel_info}: cannot send: {error.strerror}") from None
                select.select([], [], [], _RETRY)
        raise BusFault(f"bus {self._bus.channel_info}: transmit queue stays full: does any node acknowledge?")

    def receive(self, timeout: float) -> Frame | None:
        """The next data frame with an 11-bit identifier, or None after `timeout` seconds."""
        while True:
            try:
                can_id, length, data = _CAN_FRAME.unpack(self._socket.recv(_CAN_FRAME.size, self._now))
            except BlockingIOError:
                if timeout <= 0 or not select.select([self._socket], [], [], timeout)[0]:
                    return None
                timeout = 0.0
                continue
            except OSError as error:
                raise BusFault(f"bus {self._bus.channel_info}: cannot receive: {error.strerror}") from None
            if not can_id & _FLAGS:
                return can_id, data[:length]
            if can_id & _ERROR_FLAG:
                self.errors += 1
                if can_id & _BUS_OFF:
                    raise BusFault(f"bus {self._bus.channel_info}: bus-off: check wiring, termination and bit rate")


class MessagePort:
    """Any python-can interface, by its messages."""

    def __init__(self, bus: Any) -> None:
        self.errors = 0
        self._bus = bus

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; raises BusFault where python-can does."""
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except (can.CanError, OSError) as error:
            raise BusFault(f"bus {self._bus.channel_info}: cannot send: {error}") from None

    def receive(self, timeout: float) -> Frame | None:
        """The next data frame with an 11-bit identifier, or None after `timeout` seconds."""
        while True:
            try:
                message = self._bus.recv(timeout=timeout)
            except (can.CanError, OSError) as error:
                raise BusFault(f"bus {self._bus.channel_info}: cannot receive: {error}") from None
            if message is None:
                return None
            if message.is_error_frame:
                self.errors += 1
            elif not (message.is_extended_id or message.is_remote_frame):
                return message.arbitration_id, bytes(message.data)
