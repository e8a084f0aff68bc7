"""Frames as datagrams of a socket, a system call each: a call for many saves nothing that can be measured.

Subclasses define the datagram: SocketCAN's frame here, python-can's udp_multicast message in `multicast_port`.
"""

import contextlib
import errno
import itertools
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections import deque
from typing import Any

from armlink.bus.port import CLASSICAL, ERROR, REMOTE, Frame, InterfaceDown, Stamped
from armlink.errors import BusFault

FLOOD_FRAMES = 32
"""So many frames that came while none could be sent filled the bus: a wire of 125 kbit/s carries 45 in that time."""
MOST_DATAGRAMS = 4096
"""Limit of datagrams read in one call, so that a flood cannot block a reader."""
RECEIVE_BUFFER = 1 << 21
"""Size of the socket's receive queue [bytes]: some thousand frames with the kernel's overhead."""
BUS_OFF = 0x40
"""Error class bit in the identifier of an error frame."""
_RETRY = 0.002  # [s] between tries while the transmit queue is full
_TRIES = 25
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_MEMINFO = 33, 35, 55
_DROPS = struct.Struct("=32xI")  # the last of the numbers of SO_MEMINFO: frames that the receive queue had no room for
_STAMP = struct.Struct("=qq")  # wall clock [s], [ns]
_CONTROL = socket.CMSG_SPACE(_STAMP.size)
_CLOCK_TRIES, _CLOCK_SECONDS = 5, 1e-4  # two clocks are read within this time, or this often
_CLASSIC, _FD = struct.Struct("=IBB2x8s"), struct.Struct("=IBB2x64s")
_NEVER_FD, _ON_WIRE = ERROR | REMOTE | CLASSICAL, 0xFFFFFFFF
_FD_FLAGS = 0x05  # CANFD_BRS | CANFD_FDF: a CAN FD frame with bit-rate switch


class DatagramPort(ABC):
    """Port on sockets; counts error frames. A listener's is read by `wait` and `take_all`, not by `receive`."""

    longest: int
    """Size of a datagram [bytes]."""

    def __init__(
        self, name: str, receiving: socket.socket, sending: socket.socket, as_node: bool, stamped: bool
    ) -> None:
        """`name` of the bus for messages; both sockets may be the same; `as_node` as in CanBus.open_port; `stamped`:
        for a listener, with the kernel's timestamps."""
        self.errors = 0
        if stamped:
            receiving.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._began = time.monotonic()
        self._as_node, self._name = as_node, name
        self._receiving, self._send = receiving, sending.send
        self._waiting: deque[Frame] = deque()
        """Frames that came while none could be sent."""
        try:
            receiving.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:  # without CAP_NET_ADMIN limited by net.core.rmem_max
            receiving.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)

    @abstractmethod
    def _encode(self, can_id: int, data: bytes) -> bytes: ...

    @abstractmethod
    def _decoded(self, datagram: bytes, sender: Any) -> Frame | None:
        """The frame of a datagram, with flags in its identifier; None if it is none for the reader: its own echo, or
        malformed."""

    @abstractmethod
    def _take(self) -> Frame | None:
        """The frame of the next datagram, decoded. Raises OSError."""

    @property
    def dropped(self) -> int:
        """Frames lost because they were not read in time."""
        told = self._receiving.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _DROPS.size)
        return int(_DROPS.unpack(told)[0])

    def fileno(self) -> int:
        return self._receiving.fileno()

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; retries for 50 ms if the transmit queue is full, then raises BusFault."""
        datagram, tries = self._encode(can_id, data), 0
        while True:
            try:
                self._send(datagram, socket.MSG_DONTWAIT)
                return
            except OSError as error:
                if error.errno not in _FULL:
                    raise BusFault(f"bus {self._name}: cannot send: {error.strerror}") from None
            tries += 1
            if tries == _TRIES:
                raise self._full()
            select.select([], [], [], _RETRY)

    def _full(self) -> BusFault:
        """Nothing could be sent for 50 ms. Where many frames came meanwhile, they had a higher priority."""
        with contextlib.suppress(BusFault):
            while len(self._waiting) < FLOOD_FRAMES and (frame := self._next()) is not None:
                self._waiting.append(frame)
        if len(self._waiting) >= FLOOD_FRAMES:
            return BusFault(f"bus {self._name}: transmit queue stays full: frames of higher priority fill the bus")
        return BusFault(f"bus {self._name}: transmit queue stays full: does any node acknowledge?")

    def receive(self, timeout: float) -> Frame | None:
        if self._waiting:
            return self._waiting.popleft()
        if timeout <= 0:
            return self._next()
        end = time.monotonic() + timeout
        while timeout > 0 and select.select([self._receiving], [], [], timeout)[0]:
            if (frame := self._next()) is not None:
                return frame
            timeout = end - time.monotonic()
        return None

    def _next(self) -> Frame | None:
        """The next frame that is there; raises BusFault for bus-off, and where nothing can be received."""
        for _ in range(MOST_DATAGRAMS):
            try:
                frame = self._take()
            except BlockingIOError:
                return None
            except OSError as error:
                raise self._reception_fault(error) from None
            if frame is not None and self._is_frame(frame[0]):
                return frame
        return None

    def _is_frame(self, can_id: int) -> bool:
        """Whether it is no error frame; those are counted. Raises BusFault for bus-off."""
        if not can_id & ERROR:
            return True
        self.errors += 1
        if can_id & BUS_OFF and not self._as_node:
            raise BusFault(f"bus {self._name}: bus-off: check wiring, termination and bit rate")
        return False

    def _reception_fault(self, error: OSError) -> BusFault:
        fault = InterfaceDown if error.errno == errno.ENETDOWN else BusFault
        return fault(f"bus {self._name}: cannot receive: {error.strerror}")

    def wait(self, timeout: float) -> None:
        select.select([self._receiving], [], [], timeout)

    def take_all(self) -> list[Stamped]:
        """All frames in the receive queue, in order; raises BusFault.

        The kernel's timestamps are in wall-clock time. They are converted by the current difference between both
        clocks and put in order as by `in_order`, so that setting the clock affects one call only.
        """
        earliest = self._began
        self._began, ahead = _clocks()
        frames: list[Stamped] = []
        for _ in range(MOST_DATAGRAMS):
            try:
                datagram, controls, _, sender = self._receiving.recvmsg(self.longest, _CONTROL, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError as error:
                raise self._reception_fault(error) from None
            frame = self._decoded(datagram, sender)
            if frame is not None and self._is_frame(frame[0]):
                stamps = (_STAMP.unpack(content) for _, kind, content in controls if kind == _SO_TIMESTAMPNS)
                seconds, nano = next(stamps, (0, 0))
                frames.append((seconds - ahead + 1e-9 * nano, *frame))
        return in_order(frames, earliest, time.monotonic())


class SocketPort(DatagramPort):
    """On a raw SocketCAN socket: classical frames, or CAN FD frames with bit-rate switch."""

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


def in_order(frames: list[Stamped], earliest: float, latest: float) -> list[Stamped]:
    """The frames, no time before `earliest` or after `latest` or that of a later frame.

    The kernel turns its timestamps on some milliseconds after it was asked (Linux, `net_enable_timestamp`); a frame
    that came before gets the time at which it is read.
    """
    inside = frames and earliest <= frames[0][0] and frames[-1][0] <= latest
    if inside and all(one[0] <= other[0] for one, other in itertools.pairwise(frames)):
        return frames
    ordered = []
    for t, can_id, data in reversed(frames):
        latest = min(t, latest)
        ordered.append((max(latest, earliest), can_id, data))
    return ordered[::-1]


def _clocks() -> tuple[float, float]:
    """Monotonic time [s], and the wall clock's lead over it [s]."""
    for _ in range(_CLOCK_TRIES):
        before, wall, now = time.monotonic(), time.time(), time.monotonic()
        if now - before < _CLOCK_SECONDS:
            break
    return now, wall - 0.5 * (before + now)
