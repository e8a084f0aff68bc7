"""Frames as datagrams of a socket, sent and received in batches by sendmmsg and recvmmsg.

Subclasses define the datagram: SocketCAN's frame or python-can's udp_multicast message.
"""

import contextlib
import ctypes
import errno
import os
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

from armlink.bus.port import ERROR, Frame, InterfaceDown
from armlink.errors import BusFault

BATCH = 64
"""Datagrams per system call."""
FLOOD = 32
"""So many frames that came while none could be sent filled the bus: a wire of 125 kbit/s carries 45 in that time."""
MOST_BATCHES = 16
"""Limit of batches read for one frame, so that a flood of other datagrams cannot block a reader."""
RECEIVE_BUFFER = 1 << 21
"""Size of the socket's receive queue [bytes]: some thousand frames with the kernel's overhead."""
CONTROL = 64
"""Space for the control messages of one datagram [bytes]."""
NAME = 32
"""Space for the sender's address of one datagram [bytes]."""
BUS_OFF = 0x40
"""Error class bit in the identifier of an error frame."""
NOT_OURS = 1 << 32
"""Marks a datagram that is no frame for the reader: its own echo, or malformed."""
NO_FRAME = ERROR | NOT_OURS
"""Flags of everything but data and remote frames."""
_RETRY = 0.002  # [s] between tries while the transmit queue is full
_TRIES = 25
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_DONTWAIT = int(socket.MSG_DONTWAIT)
_SO_RCVBUFFORCE, _SO_RXQ_OVFL = 33, 40
_STAMP_ALONE = 32  # bytes of control messages if there is only a timestamp
_CONTROL_HEADER = struct.Struct("@Nii")
_LENGTH = struct.Struct("@56xI4x")


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


class _MessageHeader(ctypes.Structure):
    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


class DatagramBatch:
    """Preallocated datagrams and their headers for sendmmsg and recvmmsg."""

    def __init__(self, size: int, names: bool = False) -> None:
        """BATCH datagrams of at most `size` bytes; `names`: with space for each sender's address."""
        self.size = size
        self.content = bytearray(BATCH * size)
        self.names = bytearray(BATCH * NAME if names else 0)
        base, name = _address(self.content), _address(self.names) if names else None
        vectors, messages = (bytearray(BATCH * ctypes.sizeof(each)) for each in (_Vector, _MessageHeader))
        self._vectors, self._messages = memoryview(vectors).cast("Q"), memoryview(messages)
        self.messages = (_MessageHeader * BATCH).from_buffer(messages)
        self.address = ctypes.addressof(self.messages)
        first, step = _address(vectors), ctypes.sizeof(_Vector)
        for i, message in enumerate(self.messages):
            self._vectors[2 * i], self._vectors[2 * i + 1] = base + i * size, size
            message.header.vectors, message.header.vector_count = first + i * step, 1
            if name is not None:
                message.header.name, message.header.name_length = name + i * NAME, NAME

    def put(self, place: int, datagram: bytes) -> None:
        size, start = len(datagram), place * self.size
        self.content[start : start + size] = datagram
        self._vectors[2 * place + 1] = size

    def lengths(self, count: int) -> Iterator[tuple[int]]:
        """Length of each of the first `count` datagrams received."""
        return _LENGTH.iter_unpack(self._messages[: count * _LENGTH.size])


class DatagramPort(ABC):
    """Port on sockets; counts error frames and frames lost by the receive queue."""

    def __init__(
        self,
        name: str,
        receiving: socket.socket,
        sending: socket.socket,
        out: DatagramBatch,
        into: DatagramBatch,
        as_node: bool,
    ) -> None:
        """`name` of the bus for messages; both sockets may be the same; `as_node` as in CanBus.open_port."""
        self.errors = 0
        self.dropped = 0
        """Frames lost because they were not read in time (SO_RXQ_OVFL)."""
        self._as_node, self._name, self._out, self._in = as_node, name, out, into
        self._number, self._out_number = receiving.fileno(), sending.fileno()
        self._control = ctypes.create_string_buffer(CONTROL)
        self._first = into.messages[0].header
        self._first.control = ctypes.addressof(self._control)
        self._waiting: list[Frame] = []
        self._dry = False
        """The last batch emptied the receive queue: the next look needs no system call."""
        library = ctypes.CDLL(None, use_errno=True)
        self._sendmmsg, self._recvmmsg = library.sendmmsg, library.recvmmsg
        self._sendmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
        self._recvmmsg.argtypes = (*self._sendmmsg.argtypes, ctypes.c_void_p)
        self._prepare(receiving)

    def _prepare(self, receiving: socket.socket) -> None:
        """Give the socket a large receive queue and a count of lost frames."""
        try:
            receiving.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:  # without CAP_NET_ADMIN limited by net.core.rmem_max
            receiving.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        receiving.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)

    @abstractmethod
    def _encode(self, frames: Sequence[Frame]) -> None:
        """Encode at most BATCH frames into the outgoing batch."""

    @abstractmethod
    def _decode(self, count: int) -> list[Frame]:
        """Decode the first `count` datagrams, one frame each, with flags in identifiers."""

    def fileno(self) -> int:
        return self._number

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; retries for 50 ms if the transmit queue is full, then raises BusFault."""
        self.send_all(((can_id, data),))

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send the frames in this order, BATCH per system call; raises BusFault as send."""
        if len(frames) > BATCH:
            for begin in range(0, len(frames), BATCH):
                self.send_all(frames[begin : begin + BATCH])
            return
        self._encode(frames)
        sent, tries, total = 0, 0, len(frames)
        step = ctypes.sizeof(_MessageHeader)
        while sent < total:
            count = self._sendmmsg(self._out_number, self._out.address + sent * step, total - sent, _DONTWAIT)
            if count > 0:
                sent += count
                continue
            number = ctypes.get_errno()
            if number not in _FULL:
                raise BusFault(f"bus {self._name}: cannot send: {os.strerror(number)}")
            tries += 1
            if tries == _TRIES:
                raise self._full()
            select.select([], [], [], _RETRY)

    def _full(self) -> BusFault:
        """Nothing could be sent for 50 ms. Where many frames came meanwhile, they had a higher priority."""
        with contextlib.suppress(BusFault):
            if not self._waiting:
                self._fill()
        if len(self._waiting) >= FLOOD:
            return BusFault(f"bus {self._name}: transmit queue stays full: frames of higher priority fill the bus")
        return BusFault(f"bus {self._name}: transmit queue stays full: does any node acknowledge?")

    def receive(self, timeout: float) -> Frame | None:
        waiting = self._waiting
        if waiting:
            return waiting.pop()
        if timeout <= 0:
            if self._dry:
                self._dry = False
                return None
            return self._take_now()
        end = time.monotonic() + timeout
        while True:
            if not select.select([self._number], [], [], timeout)[0]:
                return None
            self._fill()
            if waiting:
                return waiting.pop()
            timeout = end - time.monotonic()
            if timeout <= 0:
                return None

    def _take_now(self) -> Frame | None:
        for _ in range(MOST_BATCHES):
            more = self._fill()
            if self._waiting:
                return self._waiting.pop()
            if not more:
                break
        return None

    def _fill(self) -> bool:
        """Read a batch; False if the receive queue is empty now."""
        self._first.control_length = CONTROL
        count = self._take_batch()
        if not count:
            return False
        self._dry = count < BATCH
        frames = self._decode(count)
        others: list[int] = []
        for can_id, _ in frames:
            if can_id & NO_FRAME:
                others = [each for each, _ in frames if each & NO_FRAME]
                frames = [frame for frame in frames if not frame[0] & NO_FRAME]
                break
        frames.reverse()
        self._waiting[:] = frames
        if others:
            self._take_others(others)  # may raise: the frames beside are kept
        return not self._dry

    def _take_batch(self) -> int:
        """Read datagrams into the batch; returns their number."""
        count: int = self._recvmmsg(self._number, self._in.address, BATCH, _DONTWAIT, None)
        if count <= 0:
            number = ctypes.get_errno()
            if number == errno.EAGAIN:
                return 0
            fault = InterfaceDown if number == errno.ENETDOWN else BusFault
            raise fault(f"bus {self._name}: cannot receive: {os.strerror(number)}")
        length = self._first.control_length
        if length not in (0, _STAMP_ALONE):
            self._read_drops(length)
        return count

    def _take_others(self, others: list[int]) -> None:
        """Count error frames; raises BusFault for bus-off."""
        errors = [can_id for can_id in others if can_id & ERROR]
        self.errors += len(errors)
        if any(can_id & BUS_OFF for can_id in errors) and not self._as_node:
            raise BusFault(f"bus {self._name}: bus-off: check wiring, termination and bit rate")

    def _read_drops(self, length: int) -> None:
        """Read the kernel's count of lost frames (32 bits) from the control messages, each aligned to eight bytes."""
        control, at = self._control.raw[:length], 0
        while at + _CONTROL_HEADER.size <= length:
            size, level, kind = _CONTROL_HEADER.unpack_from(control, at)
            if level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                self.dropped = struct.unpack_from("=I", control, at + _CONTROL_HEADER.size)[0]
            at += max(size + 7 & ~7, _CONTROL_HEADER.size)


def _address(memory: bytearray) -> int:
    return ctypes.addressof((ctypes.c_char * len(memory)).from_buffer(memory))
