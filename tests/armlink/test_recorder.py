"""Recording beside a running host: one row a SYNC, with the commands that took effect at it."""

import struct
from collections import deque

import numpy as np
import pytest

from armlink.recorder import Recorder

UNIT = 2 * np.pi / 2**20


class Tap:
    """Frames that a host and its joints exchange, each at its time."""

    def __init__(self, frames):
        self.frames, self.clock = deque(frames), self
        self.time = 100.0

    def now(self):
        return self.time

    def put(self, can_id, data):
        raise AssertionError("a recorder sends nothing")

    def take(self, timeout=0.0):
        if self.frames and self.frames[0][0] <= self.time + timeout:
            self.time, can_id, data = self.frames.popleft()
            return can_id, data
        self.time += timeout
        return None


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


def test_each_row_is_one_sync(arm_of):
    tap = Tap(conversation(9, lost=(3,)))
    rows = list(Recorder(arm_of(2), tap).rows(1.0))
    assert len(rows) == 8  # the ninth is not complete before the next SYNC
    np.testing.assert_allclose([t for t, _ in rows], np.arange(8) * 0.004, atol=1e-9)
    for cycle, (_, row) in enumerate(rows):
        second = np.nan if cycle == 3 else 1.0
        expected = np.array([2000 * cycle + 1, (2000 * cycle + 2) * second]) * UNIT
        np.testing.assert_allclose(row["position"], expected)
        np.testing.assert_allclose(row["torque"], np.array([cycle, cycle * second]))
        np.testing.assert_allclose(row["torque_command"], 0.4 * cycle)  # 10 ‰ of 40 N·m
        np.testing.assert_allclose(row["position_command"], 1000 * cycle * UNIT)
        motor = 1.0 if cycle % 4 == 0 else np.nan
        np.testing.assert_allclose(row["motor_torque"], [motor, np.nan])


def test_without_a_sync_there_is_no_row(arm_of):
    assert list(Recorder(arm_of(2), Tap([])).rows(1.0)) == []


def test_short_command_frames_are_not_decoded(arm_of):
    frames = [(100.0, 0x201, b"\x0f"), (100.001, 0x80, b""), (100.002, 0x80, b"")]
    ((_, row),) = Recorder(arm_of(2), Tap(frames)).rows(1.0)
    assert np.isnan(row["torque_command"]).all()


@pytest.mark.parametrize("seconds", [0.0101, 0.05])
def test_it_ends_when_the_time_is_over(arm_of, seconds):
    tap = Tap(conversation(100))
    rows = list(Recorder(arm_of(2), tap).rows(seconds))
    assert len(rows) == int((seconds - 0.0011) / 0.004)
