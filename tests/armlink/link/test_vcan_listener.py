"""Listening on real SocketCAN, where frames are taken a batch at a time: samples and times as the wire had them."""

import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from fake_joints import FakeBus
from vcan_pair import opened

from armlink.arm_file import Bus
from armlink.bus.bus_group import BusGroup
from armlink.bus.open import open_bus, open_link_bus
from armlink.link.listener import Listener
from armlink.link.types import Calibration

pytestmark = pytest.mark.vcan

VCAN0, VCAN1 = Bus(channel="vcan0"), Bus(channel="vcan1", fd=True)
READING = struct.Struct("<ii")
WIRE_S = 1e-3
"""Time between frames of two buses, as it takes a drive to answer: sent within microseconds, they have no order."""


@pytest.fixture(autouse=True)
def _a_vcan0():
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")


def taken(listener):
    samples = []
    while (sample := listener.next(0.2)) is not None:
        samples.append(sample)
    return samples


def test_cycles_that_waited_together_are_apart_as_they_were_sent(arm_of):
    with opened(VCAN0) as other, Listener(arm_of(2), open_bus(None, VCAN0)) as listener:
        controller, syncs = other.open_port(), []
        for cycle in range(30):
            began = time.monotonic()
            controller.send(0x80, b"")
            syncs.append((began, time.monotonic()))
            if cycle != 7:
                controller.send(0x181, READING.pack(cycle, 1_000_000 * cycle))
            controller.send(0x182, READING.pack(cycle, -1_000_000 * cycle))
        samples = taken(listener)
        assert len(samples) == 29  # the last one has no SYNC after it
        np.testing.assert_array_equal([sample.torque[1] for sample in samples], -np.arange(29.0))
        assert [cycle for cycle, sample in enumerate(samples) if np.isnan(sample.torque[0])] == [7]
        for sample, (began, ended) in zip(samples, syncs, strict=False):
            assert began - 1e-3 < sample.t < ended + 1e-3
        assert (np.diff([sample.t for sample in samples]) > 0).all()
        assert listener.stats.missed == 1


def test_two_buses_are_taken_in_the_order_of_their_frames(arm_of):
    if not Path("/sys/class/net/vcan1").exists():
        pytest.skip("needs a SocketCAN interface vcan1 with mtu 72, which scripts/with-vcan makes where it makes vcan0")
    arm = arm_of(2)
    section = arm.require_link()
    joints = (section.joints[0], section.joints[1].model_copy(update={"bus": "hand"}))
    section = section.model_copy(update={"bus": VCAN0, "buses": {"hand": VCAN1}, "joints": joints})
    arm = arm.model_copy(update={"link": section})
    group = open_link_bus(None, section)
    assert isinstance(group, BusGroup)
    with Listener(arm, open_link_bus(None, section)) as listener:
        controller = group.open_port()
        for cycle in range(30):
            for tag in group.tags.values():
                controller.send(0x80 | tag, b"")
            time.sleep(WIRE_S)
            for node, bus in ((1, ""), (2, "hand")):
                controller.send(0x180 + node | group.tags[bus], READING.pack(cycle, 1_000_000 * cycle))
            time.sleep(WIRE_S)
        samples = taken(listener)
        assert len(samples) == 29
        for joint in range(2):
            np.testing.assert_array_equal([sample.torque[joint] for sample in samples], np.arange(29.0))
    group.shutdown()


def test_a_calibration_is_read_and_written_between_the_cycles(arm_of):
    nodes, done = FakeBus((1, 2)), threading.Event()

    def serve():
        with opened(VCAN0) as bus:
            port = bus.open_port()
            while not done.is_set():
                frame = port.receive(0.05)
                if frame is not None:
                    nodes.put(*frame)
                    for each in nodes.out:
                        port.send(*each)
                    nodes.out.clear()

    thread = threading.Thread(target=serve)
    thread.start()
    with opened(VCAN0) as other, Listener(arm_of(2), open_bus(None, VCAN0)) as listener:
        controller = other.open_port()
        for cycle in range(10):
            controller.send(0x80, b"")
            controller.send(0x181, READING.pack(0, 1_000_000 * cycle))
        held = listener.write_calibration(1, Calibration(1.25, -0.5, record_id=7))
        assert (held.gain, held.offset, held.record_id) == (1.25, -0.5, 7)
        assert listener.read_calibration(1).gain == 1.25
        assert [sample.torque[0] for sample in taken(listener)] == list(range(9))
    done.set()
    thread.join()
