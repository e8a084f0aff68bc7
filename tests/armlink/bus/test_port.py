"""Ports: CAN FD frames, several buses as one, and what a SocketCAN socket does when its queues are full."""

import contextlib
import errno
import socket
import struct
import threading
import time

import can
import pytest
from vcan_pair import opened

from armlink.arm_file import Bus
from armlink.bus.bus_group import BusGroup, GroupPort
from armlink.bus.message_port import MessagePort
from armlink.bus.open import open_link_bus
from armlink.bus.port import BUS_SHIFT
from armlink.bus.sockets import datagram_port
from armlink.bus.sockets.datagram_port import SocketPort
from armlink.bus.sockets.multicast_port import MulticastPort
from armlink.errors import BadInput, BusFault, Stall


class SocketBus:
    """One end of a pair of sockets that carry CAN frames as SocketCAN does."""

    channel_info = "pair"

    def __init__(self):
        self.socket, self.other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


@pytest.fixture
def pair():
    bus = SocketBus()
    yield bus
    bus.socket.close(), bus.other.close()


def raw(can_id, data=b""):
    return struct.pack("=IB3x8s", can_id, len(data), data)


def test_frames_go_out_and_in_in_order(pair):
    port = SocketPort(pair.socket, "pair")
    for each in [(0x200 + i, bytes([i] * i)) for i in range(9)]:
        port.send(*each)
    assert [pair.other.recv(100) for _ in range(9)] == [raw(0x200 + i, bytes([i] * i)) for i in range(9)]
    for i in range(9):
        pair.other.send(raw(0x180 + i, bytes([i] * i)))
    assert [port.receive(0.0) for _ in range(9)] == [(0x180 + i, bytes([i] * i)) for i in range(9)]
    assert port.receive(0.0) is None


def test_many_frames_all_leave_in_order(pair):
    """As the two frames a cycle of 63 joints do."""
    frames = [(0x100 + i, bytes([i])) for i in range(133)]
    pair.other.setblocking(False)
    sent = []

    def drain():
        with contextlib.suppress(BlockingIOError):
            while True:
                sent.append(pair.other.recv(100))

    pair.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    port = SocketPort(pair.socket, "pair")

    def take_all():
        while len(sent) < len(frames):
            drain()
            time.sleep(1e-3)

    reader = threading.Thread(target=take_all, daemon=True)
    reader.start()
    for each in frames:
        port.send(*each)
    reader.join(30)
    assert sent == [raw(can_id, data) for can_id, data in frames]


def test_many_frames_are_all_taken(pair):
    port = SocketPort(pair.socket, "pair")
    for i in range(69):
        pair.other.send(raw(i))
    taken = []
    while (frame := port.receive(0.0)) is not None:
        taken.append(frame[0])
    assert taken == list(range(69))


def test_a_frame_that_came_after_the_queue_was_empty_is_seen_at_the_next_look(pair):
    port = SocketPort(pair.socket, "pair")
    pair.other.send(raw(1))
    assert port.receive(0.0) == (1, b"")
    assert port.receive(0.0) is None
    pair.other.send(raw(2))
    assert port.receive(0.0) == (2, b"")
    pair.other.send(raw(3))
    assert port.receive(1.0) == (3, b"")


def test_extended_and_remote_frames_come_with_their_flags_and_error_frames_are_counted(pair):
    port = SocketPort(pair.socket, "pair")
    for can_id in (0x80000001, 0x40000001, 0x20000004, 5):
        pair.other.send(raw(can_id))
    assert [port.receive(0.0) for _ in range(3)] == [(0x80000001, b""), (0x40000001, b""), (5, b"")]
    assert port.errors == 1
    assert port.receive(0.0) is None
    pair.other.send(raw(0x20000040))
    with pytest.raises(BusFault, match="bus-off: check wiring"):
        port.receive(0.0)


def test_frames_beside_a_bus_off_are_kept(pair):
    port = SocketPort(pair.socket, "pair")
    for can_id in (1, 0x20000040, 2):
        pair.other.send(raw(can_id))
    assert port.receive(0.0) == (1, b"")
    with pytest.raises(BusFault, match="bus-off: check wiring"):
        port.receive(0.0)
    assert port.receive(0.0) == (2, b"")


def test_a_queue_that_a_flood_keeps_full_is_put_down_to_it(pair, monkeypatch):
    monkeypatch.setattr(datagram_port, "_RETRY", 0.0)
    port = SocketPort(pair.socket, "pair")

    def send(datagram, flags):
        raise OSError(errno.ENOBUFS, "No buffer space available")

    port._send = send
    for _ in range(datagram_port.FLOOD_FRAMES):
        pair.other.send(raw(0x001))
    with pytest.raises(BusFault, match="transmit queue stays full: frames of higher priority fill the bus"):
        port.send(1, b"")
    assert port.receive(0.0) == (0x001, b"")


def test_a_full_transmit_queue_is_waited_for_then_said(pair, monkeypatch):
    monkeypatch.setattr(datagram_port, "_RETRY", 0.0)
    port = SocketPort(pair.socket, "pair")
    real, refusals = port._send, [3]

    def send(datagram, flags):
        if refusals[0]:
            refusals[0] -= 1
            raise OSError(errno.ENOBUFS, "No buffer space available")
        return real(datagram, flags)

    port._send = send
    for each in [(1, b"a"), (2, b"b"), (3, b"c")]:
        port.send(*each)
    assert [pair.other.recv(100) for _ in range(3)] == [raw(1, b"a"), raw(2, b"b"), raw(3, b"c")]
    refusals[0] = 1000
    with pytest.raises(BusFault, match="transmit queue stays full: does any node acknowledge"):
        port.send(1, b"")


def test_datagrams_that_this_machine_does_not_take_are_no_fault_of_a_node(monkeypatch):
    port = MulticastPort.__new__(MulticastPort)
    port._name = "udp_multicast:239.0.0.1"
    error = port._full()
    assert isinstance(error, Stall)
    assert "this machine accepted no datagrams for 50 ms" in str(error)
    assert "node" not in str(error)


def test_a_socket_that_fails_is_a_bus_fault(pair):
    port = SocketPort(pair.socket, "pair")
    pair.other.close()
    with pytest.raises(BusFault, match="cannot send"):
        port.send(1, b"")


def test_can_fd_frames_carry_the_bit_rate_switch(pair):
    port = SocketPort(pair.socket, "pair", fd=True)
    port.send(0x201, b"abc")
    frame = pair.other.recv(100)
    assert (len(frame), frame[4], frame[5] & 1, frame[8:11]) == (72, 3, 1, b"abc")
    pair.other.send(raw(0x181, b"xy"))
    pair.other.send(struct.pack("=IBB2x64s", 0x182, 12, 1, bytes(range(12))))
    assert port.receive(0.0) == (0x181, b"xy")
    assert port.receive(0.0) == (0x182, bytes(range(12)))


def test_an_fd_bus_of_python_can_sends_fd_messages():
    with (
        opened(Bus(interface="virtual", channel="fd", fd=True)) as bus,
        can.Bus(interface="virtual", channel="fd", protocol=can.CanProtocol.CAN_FD) as other,
    ):
        port = bus.open_port()
        assert isinstance(port, MessagePort)
        port.send(0x201, b"abc")
        message = other.recv(0)
        assert (message.is_fd, message.bitrate_switch, bytes(message.data)) == (True, True, b"abc")


@pytest.fixture
def group(arm_of):
    section = arm_of(3).require_link()
    joints = [joint.model_copy(update={"bus": "wrist"}) if joint.node == 3 else joint for joint in section.joints]
    buses = {"wrist": Bus(interface="virtual", channel="wrist")}
    bus = Bus(interface="virtual", channel="base")
    group = open_link_bus(None, section.model_copy(update={"joints": tuple(joints), "buses": buses, "bus": bus}))
    yield group
    group.shutdown()


def test_frames_go_to_the_bus_that_their_identifier_names_and_come_back_with_it(group):
    assert group.tags == {"": 0, "wrist": 1 << BUS_SHIFT}
    wrist_tag = group.tags["wrist"]
    assert isinstance(group, BusGroup)
    with (
        can.Bus(interface="virtual", channel="base") as base,
        can.Bus(interface="virtual", channel="wrist") as wrist,
    ):
        port = group.open_port()
        assert isinstance(port, GroupPort)
        for each in [(0x201, b"1"), (0x201 | wrist_tag, b"3"), (0x80, b""), (0x80 | wrist_tag, b"")]:
            port.send(*each)
        port.send(0x000, b"\x01\x00")
        port.send(0x603 | wrist_tag, b"x")
        heard = {bus: [] for bus in (base, wrist)}
        for bus, frames in heard.items():
            while (message := bus.recv(0)) is not None:
                frames.append(message.arbitration_id)
        assert heard[base] == [0x201, 0x80, 0x000]
        assert heard[wrist] == [0x201, 0x80, 0x603]
        wrist.send(can.Message(arbitration_id=0x181, data=b"w", is_extended_id=False))
        base.send(can.Message(arbitration_id=0x181, data=b"b", is_extended_id=False))
        assert sorted(filter(None, (port.receive(0.1) for _ in range(2)))) == [(0x181, b"b"), (0x181 | wrist_tag, b"w")]
        assert port.receive(0.0) is None
        wrist.send(can.Message(arbitration_id=0x181, data=b"w", is_extended_id=False))
        assert group.recv(0.1).arbitration_id == 0x181
        assert group.recv(0.0) is None


def test_one_bus_on_the_command_line_takes_every_joint(arm_of):
    section = arm_of(3, link={"bus": {"interface": "virtual", "channel": "a"}}).require_link()
    bus = open_link_bus("virtual:b", section)
    assert not isinstance(bus, BusGroup)
    bus.shutdown()


def test_a_bus_that_is_not_there_is_named(arm_of):
    with pytest.raises(BadInput, match=r"joint_1 is on bus 'tool', which link\.buses does not have"):
        arm_of(1, joint={"bus": "tool"})
