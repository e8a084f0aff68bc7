"""A wire to listen on: what a host and its joints say, for tests of those who send nothing."""

import struct
from collections import deque

from armlink.bus.in_process import InProcessBus


class Tap(InProcessBus):
    """Frames that a host and its joints exchange, each at its time; anything sent is a failure."""

    channel_info = "tap"

    def __init__(self, frames):
        self.frames, self.clock = deque(frames), self
        self.time = 100.0

    def now(self):
        return self.time

    def put(self, can_id, data):
        raise AssertionError("who only listens sends nothing")

    def take(self, timeout=0.0):
        if self.frames and self.frames[0][0] <= self.time + timeout:
            self.time, can_id, data = self.frames.popleft()
            return can_id, data
        self.time += timeout
        return None

    def shutdown(self):
        pass


def conversation(cycles, lost=()):
    """Two joints (nodes 1, 2) at 250 Hz: commands, SYNC, readings; joint 2's readings of `lost` cycles are missing."""
    for cycle in range(cycles):
        t = 100.001 + cycle * 0.004
        for node in (1, 2):
            yield t, 0x200 + node, struct.pack("<Hhi", 15, 10 * cycle, 1000 * cycle)
        yield t + 0.0001, 0x80, b""
        for node in (1, 2):
            if node == 1 or cycle not in lost:
                yield t + 0.0005, 0x180 + node, struct.pack("<ii", 2000 * cycle + node, 1_000_000 * cycle)
        if cycle % 4 == 0:
            yield t + 0.0006, 0x281, struct.pack("<Hhi", 0x27, 25, 500)
