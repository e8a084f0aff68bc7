"""Listening beside another controller: samples as a host would have them, and not a frame sent."""

import struct
from collections import deque

import numpy as np

from armlink.listener import Listener

UNIT = 2 * np.pi / 2**20


class Tap:
    """Frames that a host and its joints exchange, each at its time; anything sent is a failure."""

    channel_info = "tap"

    def __init__(self, frames):
        self.frames, self.clock = deque(frames), self
        self.time = 100.0

    def now(self):
        return self.time

    def put(self, can_id, data):
        raise AssertionError("a listener sends nothing")

    def take(self, timeout=0.0):
        if self.frames and self.frames[0][0] <= self.time + timeout:
            self.time, can_id, data = self.frames.popleft()
            return can_id, data
        self.time += timeout
        return None

    def shutdown(self):
        pass


def conversation(cycles, lost=()):
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


def heard(listener, seconds):
    samples = []
    while (sample := listener.next(seconds)) is not None:
        samples.append(sample)
    return samples


def test_each_sync_of_the_other_controller_gives_one_sample(arm_of):
    listener = Listener(arm_of(2), Tap(conversation(9, lost=(3,))))
    samples = heard(listener, 1.0)
    assert len(samples) == 8  # the ninth is not complete before the next SYNC
    np.testing.assert_allclose(np.diff([sample.t for sample in samples]), 0.004, atol=1e-9)
    for cycle, sample in enumerate(samples):
        second = np.nan if cycle == 3 else 1.0
        np.testing.assert_allclose(sample.position, np.array([2000 * cycle + 1, (2000 * cycle + 2) * second]) * UNIT)
        np.testing.assert_allclose(sample.torque, np.array([cycle, cycle * second]))
    assert samples[4].age[1] == 0.0
    assert samples[3].age[1] > 0.0
    assert listener.stats.missed == 1


def test_the_other_controllers_commands_are_known(arm_of):
    listener = Listener(arm_of(2), Tap(conversation(3)))
    heard(listener, 1.0)
    np.testing.assert_allclose(listener.torque_sent, 0.4 * 2)  # 20 ‰ of 40 N·m
    np.testing.assert_allclose(listener.position_sent, 2000 * UNIT)


def test_a_silent_bus_gives_nothing_and_takes_no_longer_than_asked(arm_of):
    tap = Tap([])
    assert Listener(arm_of(2), tap).next(0.5) is None
    assert 100.5 <= tap.time < 100.6


def test_emergencies_and_restarts_are_kept(arm_of):
    frames = [(100.0, 0x80, b""), (100.001, 0x81, struct.pack("<HB5x", 0x4310, 1)), (100.002, 0x702, b"\0")]
    listener = Listener(arm_of(2), Tap(frames))
    listener.next(0.1)
    assert [(joint, code) for joint, code, _ in listener.emergencies] == [(0, 0x4310)]
    assert listener.node_states == {1: 0}
