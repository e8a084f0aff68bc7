"""Ports for listeners: batches of frames with the kernel's timestamps, on SocketCAN and udp_multicast."""

import ctypes
import select
import socket
import struct
import time

from armlink.bus.port import Stamped
from armlink.bus.sockets.datagram_port import BATCH, CONTROL, FLAGS, DatagramPort
from armlink.bus.sockets.multicast_port import MulticastPort
from armlink.bus.sockets.socket_port import SocketPort

MOST_BATCHES = 256
"""So many batches are taken at once: frames without end do not keep a listener for ever."""
_SO_TIMESTAMPNS = 35
_STAMP = struct.Struct("=16xqq32x")  # the first control message of a frame, by the wall clock [s], [ns]; CONTROL bytes
_CLOCK_TRIES, _CLOCK_SECONDS = 5, 1e-4  # two clocks are read so close together, or so often tried


class Stamping(DatagramPort):
    """A port whose frames are taken in batches, with their times: by `wait` and `take_all`, not by `receive`."""

    def _prepare(self, receiving: socket.socket) -> None:
        """Let the kernel stamp what comes; every datagram has room for its control messages."""
        super()._prepare(receiving)
        receiving.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._control = ctypes.create_string_buffer(BATCH * CONTROL)
        base = ctypes.addressof(self._control)
        for i, message in enumerate(self._in.messages):
            message.header.control, message.header.control_length = base + i * CONTROL, CONTROL
        self._headers = bytes(self._in.messages)  # as the kernel wants them: it writes lengths into them
        self._stamps = memoryview(self._control)
        self._began = time.monotonic()

    def wait(self, timeout: float) -> None:
        """Return when a frame is there, or after `timeout` seconds."""
        select.select([self._number], [], [], timeout)

    def take_all(self) -> list[Stamped]:
        """All frames that are there, in their order; raises BusFault.

        The kernel's stamps are by the wall clock: they are brought to the monotonic one by the difference of the two
        at this moment, and kept between the last call and this one, so that a clock that is set spoils one batch.
        """
        earliest = self._began
        self._began, ahead = _clocks()
        frames: list[Stamped] = []
        others: list[int] = []
        for _ in range(MOST_BATCHES):
            ctypes.memmove(self._in.address, self._headers, len(self._headers))
            count = self._take_batch()
            stamps = _STAMP.iter_unpack(self._stamps[: count * CONTROL])
            for (can_id, data), (seconds, nano) in zip(self._decode(count), stamps, strict=True):
                if can_id & FLAGS:
                    others.append(can_id)
                else:
                    frames.append((seconds - ahead + 1e-9 * nano, can_id, data))
            if count < BATCH:
                break
        if others:
            self._take_others(others)
        latest = time.monotonic()
        if frames and not earliest <= frames[0][0] <= frames[-1][0] <= latest:
            frames = [(min(max(t, earliest), latest), can_id, data) for t, can_id, data in frames]
        return frames


class StampedSocketPort(Stamping, SocketPort):
    """SocketCAN with timestamps."""


class StampedMulticastPort(Stamping, MulticastPort):
    """udp_multicast with timestamps."""


def _clocks() -> tuple[float, float]:
    """The monotonic clock [s], and how far the wall clock is ahead of it [s]."""
    for _ in range(_CLOCK_TRIES):
        before, wall, now = time.monotonic(), time.time(), time.monotonic()
        if now - before < _CLOCK_SECONDS:
            break
    return now, wall - 0.5 * (before + now)
