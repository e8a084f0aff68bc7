"""SocketCAN without an object or a system call a frame: whole batches through sendmmsg and recvmmsg, raw sockets."""

import ctypes
import errno
import os
import select
import socket
import struct
from collections.abc import Sequence
from typing import Any

from armlink.errors import BusFault

Frame = tuple[int, bytes]

BATCH = 64
"""Frames a system call takes."""
RECEIVE_BUFFER = 1 << 21
"""Bytes of the socket's receive queue, which the kernel counts with its own overhead: some thousand frames."""
_CLASSIC, _FD = struct.Struct("=IBB2x8s"), struct.Struct("=IBB2x64s")
_FD_FLAGS = 0x05  # CANFD_BRS | CANFD_FDF: a CAN FD frame with bit-rate switch
FLAGS = 0xE0000000
"""Extended, remote, error."""
_ERROR_FLAG, _BUS_OFF = 0x20000000, 0x40
_RETRY = 0.002  # [s] between tries while the transmit queue is full
_TRIES = 25
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_DONTWAIT = int(socket.MSG_DONTWAIT)
_SO_RCVBUFFORCE, _SO_RXQ_OVFL = 33, 40
CONTROL = 64
"""Bytes for the control messages of one frame."""
_CONTROL_HEADER = struct.Struct("@Nii")


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


class Batch:
    """Preallocated frames and the headers that point at them, as sendmmsg and recvmmsg take them."""

    def __init__(self, size: int) -> None:
        """BATCH frames of `size` bytes; no control messages."""
        self.frames = bytearray(BATCH * size)
        base = ctypes.addressof((ctypes.c_char * len(self.frames)).from_buffer(self.frames))
        self._vectors = (_Vector * BATCH)(*(_Vector(base + i * size, size) for i in range(BATCH)))
        first, step = ctypes.addressof(self._vectors), ctypes.sizeof(_Vector)
        self.messages = (_Message * BATCH)(
            *(_Message(_Header(vectors=first + i * step, vector_count=1)) for i in range(BATCH))
        )
        self.address = ctypes.addressof(self.messages)


class SocketPort:
    """The raw socket of a python-can SocketCAN bus; classical frames, or CAN FD with bit-rate switch where it is on."""

    def __init__(self, bus: Any, fd: bool = False) -> None:
        self.errors = 0
        self.dropped = 0
        """Frames that the receive queue lost because they were not read in time (SO_RXQ_OVFL)."""
        self._name = bus.channel_info
        self._socket: socket.socket = bus.socket
        self._number: int = self._socket.fileno()
        self._layout, self._flags = (_FD, _FD_FLAGS) if fd else (_CLASSIC, 0)
        self._out, self._in = Batch(self._layout.size), Batch(self._layout.size)
        self._received = memoryview(self._in.frames)
        self._control = ctypes.create_string_buffer(CONTROL)
        self._first = self._in.messages[0].header
        self._first.control = ctypes.addressof(self._control)
        self._waiting: list[Frame] = []
        self._dry = False
        """The last batch was all that there was: it need not be asked again at once."""
        library = ctypes.CDLL(None, use_errno=True)
        self._sendmmsg, self._recvmmsg = library.sendmmsg, library.recvmmsg
        self._sendmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
        self._recvmmsg.argtypes = (*self._sendmmsg.argtypes, ctypes.c_void_p)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:  # without CAP_NET_ADMIN as much as net.core.rmem_max allows
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)

    def fileno(self) -> int:
        """The socket, for select."""
        return self._number

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; a full transmit queue is tried again for some milliseconds, then BusFault."""
        self.send_all(((can_id, data),))

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send up to BATCH frames in this order by one system call; raises BusFault as send."""
        buffer, pack, size, flags = self._out.frames, self._layout.pack_into, self._layout.size, self._flags
        for i, (can_id, data) in enumerate(frames):
            pack(buffer, i * size, can_id, len(data), flags, data)
        sent, tries, total = 0, 0, len(frames)
        step = ctypes.sizeof(_Message)
        while sent < total:
            count = self._sendmmsg(self._number, self._out.address + sent * step, total - sent, _DONTWAIT)
            if count > 0:
                sent += count
                continue
            number = ctypes.get_errno()
            if number not in _FULL:
                raise BusFault(f"bus {self._name}: cannot send: {os.strerror(number)}")
            tries += 1
            if tries == _TRIES:
                raise BusFault(f"bus {self._name}: transmit queue stays full: does any node acknowledge?")
            select.select([], [], [], _RETRY)

    def receive(self, timeout: float) -> Frame | None:
        """The next data frame with an 11-bit identifier, or None after `timeout` seconds."""
        while True:
            if self._waiting:
                return self._waiting.pop()
            if timeout > 0:
                if not select.select([self._number], [], [], timeout)[0]:
                    return None
                timeout = 0.0
            elif self._dry:
                self._dry = False
                return None
            if not self._fill():
                return None

    def _fill(self) -> bool:
        """Take in a batch; False where nothing was there."""
        self._first.control_length = CONTROL
        count = self._take_batch()
        if not count:
            return False
        self._dry = count < BATCH
        frames, others = self._waiting, []
        for can_id, length, _, data in self._layout.iter_unpack(self._received[: count * self._layout.size]):
            if not can_id & FLAGS:
                frames.append((can_id, data[:length]))
            else:
                others.append(can_id)
        frames.reverse()
        if others:
            self._take_others(others)
        return True

    def _take_batch(self) -> int:
        """How many frames are in the batch now, 0 where nothing was there."""
        count: int = self._recvmmsg(self._number, self._in.address, BATCH, _DONTWAIT, None)
        if count <= 0:
            number = ctypes.get_errno()
            if number == errno.EAGAIN:
                return 0
            raise BusFault(f"bus {self._name}: cannot receive: {os.strerror(number)}")
        length = self._first.control_length
        if length:
            self._read_drops(length)
        return count

    def _take_others(self, others: list[int]) -> None:
        """Frames that are no data frames with an 11-bit identifier: those that tell of errors count."""
        errors = [can_id for can_id in others if can_id & _ERROR_FLAG]
        self.errors += len(errors)
        if any(can_id & _BUS_OFF for can_id in errors):
            raise BusFault(f"bus {self._name}: bus-off: check wiring, termination and bit rate")

    def _read_drops(self, length: int) -> None:
        """The kernel's count of lost frames, 32 bits; among control messages, each aligned to eight bytes."""
        control, at = self._control.raw[:length], 0
        while at + _CONTROL_HEADER.size <= length:
            size, level, kind = _CONTROL_HEADER.unpack_from(control, at)
            if level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                self.dropped = struct.unpack_from("=I", control, at + _CONTROL_HEADER.size)[0]
            at += max(size + 7 & ~7, _CONTROL_HEADER.size)
