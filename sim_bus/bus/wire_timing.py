"""Timing of the wire: frames in sequence at a bit rate, arbitration by identifier, transmit queues of limited length.

Takes the place of the arm on a LockStepBus. Frames of the host wait in its transmit queue (in order), frames of nodes
in their mailboxes. Whenever the wire is free, the lowest identifier wins arbitration (ISO 11898-1, 10.4.3) and
occupies the wire for its bits, stuff bits included. Frames left at the end of a period follow in the next. A period
of the physics is not divided: nodes sample when SYNC arrives, then the whole period passes.
"""

import heapq
from collections import deque
from itertools import count
from typing import Protocol

from armlink.bus.frame_bits import frame_bits
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.errors import BusFault
from sim_bus.node.pdo import Frame

PATIENCE = 0.05
"""Longest wait of a host for space in its transmit queue [s]."""
TRANSMIT_QUEUE = 10
"""Length of a host's transmit queue: SocketCAN's default (txqueuelen)."""


class TimedArm(Protocol):
    outbox: deque[Frame]

    def on_frame(self, can_id: int, data: bytes) -> None: ...

    def advance(self, duration: float) -> None: ...


class TimedWire:
    """A wire of `bitrate` [bit/s] in front of `line`, with on_frame(), advance() and `outbox` of the arm."""

    def __init__(self, line: TimedArm, bitrate: int, transmit_queue: int = TRANSMIT_QUEUE) -> None:
        self.line, self.bitrate, self.transmit_queue = line, bitrate, transmit_queue
        self.outbox: deque[Frame] = deque()
        self.time = self._free = 0.0
        """Times [s]: end of the last period; when the wire becomes free."""
        self._busy = self._cycling = 0.0
        """Sums over cycles [s]: time with a frame on the wire; length."""
        self._on_wire = 0.0
        self._host: deque[Frame] = deque()
        self._nodes: list[tuple[int, int, bytes]] = []
        self._order = count()
        self._synced = False

    @property
    def load(self) -> float:
        """Share of the cycle time in which a frame is on the wire."""
        return self._busy / self._cycling if self._cycling else 0.0

    def on_frame(self, can_id: int, data: bytes) -> None:
        """Queue a frame of the host; if the queue is full, the host waits until a frame has been sent.

        Raises BusFault if that takes longer than PATIENCE.
        """
        self._free = max(self._free, self.time)
        while len(self._host) >= self.transmit_queue:
            if self._free > self.time + PATIENCE:
                raise BusFault("wire: transmit queue stays full: frames of higher priority occupy the whole bus")
            self._send_next()
        self._host.append((can_id, data))

    def advance(self, duration: float) -> None:
        """Advance simulated time [s]: first the frames that fit, then the physics."""
        end = self.time + duration
        self._free = max(self._free, self.time)
        self._collect()
        while self._free < end - 1e-12 and (self._host or self._nodes):
            self._send_next()
        if self._synced:
            self._busy += self._on_wire
            self._cycling += duration
        self._synced, self._on_wire = False, 0.0
        self.line.advance(duration)
        self._collect()
        self.time = end

    def _send_next(self) -> None:
        if self._host and (not self._nodes or self._host[0][0] <= self._nodes[0][0]):
            can_id, data = self._host.popleft()
            self._occupy(can_id, data)
            self._synced |= can_id == SYNC_ID
            self.line.on_frame(can_id, data)
            self._collect()
        else:
            can_id, _, data = heapq.heappop(self._nodes)
            self._occupy(can_id, data)
            self.outbox.append((can_id, data))

    def _occupy(self, can_id: int, data: bytes) -> None:
        time = frame_bits(can_id & 0x7FF, data) / self.bitrate
        self._free += time
        self._on_wire += time

    def _collect(self) -> None:
        sent = self.line.outbox
        while sent:
            can_id, data = sent.popleft()
            heapq.heappush(self._nodes, (can_id, next(self._order), data))
