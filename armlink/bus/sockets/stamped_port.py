"""Ports for listeners: batches of frames with the kernel's timestamps."""

import ctypes
import itertools
import select
import socket
import struct
import time

from armlink.bus.port import Stamped
from armlink.bus.sockets.datagram_port import BATCH, CONTROL, NO_FRAME, DatagramPort
from armlink.bus.sockets.socket_port import SocketPort

MOST_BATCHES = 256
"""Limit of batches per call, so that a flood cannot block a listener."""
_SO_TIMESTAMPNS = 35
_STAMP = struct.Struct("=16xqq32x")  # first control message of a frame: wall clock [s], [ns]
_CLOCK_TRIES, _CLOCK_SECONDS = 5, 1e-4  # two clocks are read within this time, or this often


class Stamping(DatagramPort):
    """A port that is read by `wait` and `take_all`, not by `receive`."""

    def _prepare(self, receiving: socket.socket) -> None:
        """Turn on the kernel's timestamps; every datagram has space for its control messages."""
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
        select.select([self._number], [], [], timeout)

    def take_all(self) -> list[Stamped]:
        """All frames in the receive queue, in order; raises BusFault.

        The kernel's timestamps are in wall-clock time. They are converted by the current difference between both
        clocks and put in order as by `in_order`, so that setting the clock affects one batch only.
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
                if can_id & NO_FRAME:
                    others.append(can_id)
                else:
                    frames.append((seconds - ahead + 1e-9 * nano, can_id, data))
            if count < BATCH:
                break
        if others:
            self._take_others(others)
        return in_order(frames, earliest, time.monotonic())


class StampedSocketPort(Stamping, SocketPort):
    """SocketCAN with timestamps."""


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
