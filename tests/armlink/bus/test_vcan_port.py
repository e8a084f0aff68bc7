"""The port on real SocketCAN: lost frames are counted, two buses are one, CAN FD frames go and come."""

from pathlib import Path

import can
import pytest
from vcan_pair import opened

from armlink.arm_file import Bus
from armlink.bus.open import open_link_bus

pytestmark = pytest.mark.vcan

VCAN0, VCAN1 = Bus(channel="vcan0"), Bus(channel="vcan1", fd=True)
CYCLE = [(0x180 + node, bytes(8)) for node in range(1, 61)]


@pytest.fixture(autouse=True)
def _a_vcan0():
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")


def test_a_slow_reader_knows_how_many_frames_it_lost():
    with opened(VCAN0) as sender, opened(VCAN0) as reader:
        sending, reading = sender.open_port(), reader.open_port()
        sent = 0
        while sent < 400 * len(CYCLE):
            for each in CYCLE:
                sending.send(*each)
            sent += len(CYCLE)
        taken = 0
        while reading.receive(0.0) or reading.receive(0.01):
            taken += 1
        sending.send(0x80, b"")
        assert reading.receive(1.0) == (0x80, b"")
        assert taken >= 400  # some 25 cycles of seven joints
        assert reading.dropped == sent - taken > 0


def test_two_buses_one_of_them_can_fd_are_one(arm_of):
    if not Path("/sys/class/net/vcan1").exists():
        pytest.skip("needs a SocketCAN interface vcan1 with mtu 72, which scripts/with-vcan makes where it makes vcan0")
    section = arm_of(2).require_link()
    joints = (section.joints[0], section.joints[1].model_copy(update={"bus": "hand"}))
    two = section.model_copy(update={"bus": VCAN0, "buses": {"hand": VCAN1}, "joints": joints})
    group = open_link_bus(None, two)
    with (
        can.Bus(interface="socketcan", channel="vcan0") as base,
        can.Bus(interface="socketcan", channel="vcan1", fd=True) as hand,
    ):
        port = group.open_port()
        tag = group.tags["hand"]
        for each in [(0x201, b"one"), (0x80, b""), (tag | 0x202, b"two"), (tag | 0x80, b"")]:
            port.send(*each)
        heard = {bus: [bus.recv(1.0), bus.recv(1.0)] for bus in (base, hand)}
        assert [m.arbitration_id for m in heard[base]] == [0x201, 0x80]
        assert [(m.arbitration_id, m.is_fd, m.bitrate_switch) for m in heard[hand]] == [
            (0x202, True, True),
            (0x80, True, True),
        ]
        hand.send(can.Message(arbitration_id=0x182, data=b"fd", is_extended_id=False, is_fd=True))
        base.send(can.Message(arbitration_id=0x181, data=b"classic", is_extended_id=False))
        assert {port.receive(1.0), port.receive(1.0)} == {(tag | 0x182, b"fd"), (0x181, b"classic")}
    group.shutdown()
