"""The wire's own time: frames one after the other at a bit rate, the lowest identifier first, queues that fill up.

Stands in for the arm on a LockStepBus: what the host sends waits in its transmit queue (in order), what nodes send in
their mailboxes; whenever the wire is free the lowest identifier of those waiting goes (ISO 11898-1, 10.4.3), for as
long as its bits take, stuff bits included. What is not through when a period is over comes in the next. Within a period
the physics is not divided: nodes sample when the SYNC arrives, then the whole period passes.
"""

import heapq
from collections import deque
from itertools import count
from typing import Protocol

from armlink.bus.frame_bits import frame_bits
from armlink.canopen.object_dictionary import SYNC_ID
from armlink.errors import BusFault
from sim_bus.node.pdo import Frame

PATIENCE = 0.05
"""How long a host waits for room in its transmit queue [s]."""
TRANSMIT_QUEUE = 10
"""Frames that a host's transmit queue holds: SocketCAN's default (txqueuelen)."""


class Line(Protocol):
    """The arm, or what stands in for it."""

    outbox: deque[Frame]

    def on_frame(self, can_id: int, data: bytes) -> None:
        """A frame from the host."""

    def advance(self, duration: float) -> None:
        """Let simulated time pass [s]."""


class Wire:
    """A bus of `bitrate` [bit/s] before `line`; on_frame(), advance() and `outbox` as the arm has them."""

    def __init__(self, line: Line, bitrate: int, transmit_queue: int = TRANSMIT_QUEUE) -> None:
        """An idle bus."""
        self.line, self.bitrate, self.transmit_queue = line, bitrate, transmit_queue
        self.outbox: deque[Frame] = deque()
        self.time = self._free = 0.0
        """The bus's time [s]: end of the last period; when the wire is free."""
        self.full = 0
        """How often a frame of the host's found the transmit queue full, and waited."""
        self._busy = self._waited = self._cycling = 0.0
        """Of the cycles: time with a frame on the wire; from their starts to their last frames; their own [s]."""
        self._on_wire = 0.0
        self._host: deque[Frame] = deque()
        self._nodes: list[tuple[int, int, bytes]] = []
        self._order = count()
        self._synced = False

    @property
    def load(self) -> float:
        """Share of the cycles' time in which a frame is on the wire."""
        return self._busy / self._cycling if self._cycling else 0.0

    @property
    def wait_share(self) -> float:
        """Share of the cycles in which the host can but wait for the wire: from their starts to their last frames."""
        return self._waited / self._cycling if self._cycling else 0.0

    def on_frame(self, can_id: int, data: bytes) -> None:
        """Queue a frame of the host's; where the queue is full the host waits until a frame has gone.

        Raises BusFault where that takes longer than a host is patient.
        """
        self._free = max(self._free, self.time)
        while len(self._host) >= self.transmit_queue:
            self.full += 1
            if self._free > self.time + PATIENCE:
                raise BusFault("wire: transmit queue stays full: frames of higher priority take the whole bus")
            self._send_next()
        self._host.append((can_id, data))

    def advance(self, duration: float) -> None:
        """Let simulated time pass [s]: the frames that it has room for, then the physics."""
        end = self.time + duration
        self._free = max(self._free, self.time)
        self._collect()
        while self._free < end - 1e-12 and (self._host or self._nodes):
            self._send_next()
        if self._synced:
            self._busy += self._on_wire
            self._waited += min(self._free, end) - self.time
            self._cycling += duration
        self._synced, self._on_wire = False, 0.0
        self.line.advance(duration)
        self._collect()
        self.time = end

    def _send_next(self) -> None:
        """Let the winner of the arbitration through."""
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
        """What the nodes have to send."""
        sent = self.line.outbox
        while sent:
            can_id, data = sent.popleft()
            heapq.heappush(self._nodes, (can_id, next(self._order), data))
