"""The wire's time: frames one after the other, lowest identifier first, full queues; against sums done by hand."""

from collections import deque

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.bus.frame_bits import frame_bits
from armlink.errors import BusFault
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.bus.wire_timing import TimedWire

PERIOD = 0.004


class Nodes:
    """Answers a SYNC by these frames."""

    def __init__(self, *answers: tuple[int, bytes]) -> None:
        self.answers, self.outbox, self.heard = answers, deque(), []

    def on_frame(self, can_id: int, data: bytes) -> None:
        self.heard.append((can_id, data))
        if can_id == 0x80:
            self.outbox.extend(self.answers)

    def advance(self, duration: float) -> None:
        pass


def test_frames_go_one_after_the_other_for_as_long_as_their_bits_take() -> None:
    answers = (0x183, bytes(8)), (0x181, b"\x55" * 8)
    wire = TimedWire(Nodes(*answers), 1_000_000)
    command = (0x201, b"\xaa\x01\x02\x03")
    wire.on_frame(*command)
    wire.on_frame(0x80, b"")
    wire.advance(PERIOD)
    seconds = sum(frame_bits(*frame) for frame in (*answers, command, (0x80, b""))) * 1e-6
    assert wire.load == pytest.approx(seconds / PERIOD)


def test_the_lowest_identifier_wins() -> None:
    wire = TimedWire(Nodes((0x183, b"c"), (0x701, b"d"), (0x81, b"a"), (0x181, b"b")), 1_000_000)
    wire.on_frame(0x80, b"")
    wire.on_frame(0x182, b"host")
    wire.advance(PERIOD)
    assert [data for _, data in wire.outbox] == [b"a", b"b", b"c", b"d"]
    assert wire.line.heard == [(0x80, b""), (0x182, b"host")]


def test_what_has_no_room_in_a_period_comes_in_the_next() -> None:
    wire = TimedWire(Nodes(*((0x180 + node, bytes(8)) for node in range(1, 60))), 1_000_000)
    wire.on_frame(0x80, b"")
    wire.advance(PERIOD)
    first = len(wire.outbox)
    assert first == pytest.approx(PERIOD / 130e-6, abs=4)
    assert wire.load == pytest.approx(1.0, abs=0.05)
    wire.advance(PERIOD)
    assert len(wire.outbox) == 59


def test_a_full_transmit_queue_is_waited_for_and_then_given_up() -> None:
    wire = TimedWire(Nodes(*((0x001, bytes(8)) for _ in range(1000))), 1_000_000)
    wire.on_frame(0x80, b"")
    wire.advance(PERIOD)
    for _ in range(10):
        wire.on_frame(0x201, bytes(8))
    with pytest.raises(BusFault, match="transmit queue stays full"):
        wire.on_frame(0x201, bytes(8))


def test_the_arm_on_a_wire_reads_the_same_and_a_cycle_takes_what_the_standard_says() -> None:
    samples = []
    for timing in (False, True):
        bus = LockStepBus("sarcos", timing=timing)
        with Link(load_arm("sarcos"), bus) as link:
            link.start()
            command = Command.hold(np.array(link.enable().position))
            for _ in range(100):
                sample = link.cycle(command)
            samples.append(sample)
            if bus.wire is not None:  # 7 × (8 + 8 bytes) and SYNC: 40 to 49 % at 250 Hz, TPDO2 and heartbeats on top
                assert 0.40 < bus.wire.load < 0.56
                assert link.stats.missed == 0
    np.testing.assert_allclose(samples[0].position, samples[1].position, atol=1e-3)


def test_a_slow_bus_is_too_slow_for_seven_joints_and_that_is_seen() -> None:
    bus = LockStepBus("sarcos", timing=True, bitrate=250_000)
    with Link(load_arm("sarcos"), bus) as link:
        link.start()
        with pytest.raises(BusFault, match=r"complete|frames|reading|stays"):
            link.enable()
    assert bus.wire is not None
    assert bus.wire.load > 0.95
