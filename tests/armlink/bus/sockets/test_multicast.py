"""udp_multicast: the same datagrams as python-can's, both ways, and nothing else gets in."""

import itertools
import os
import socket
import time
from contextlib import contextmanager

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.arm_file import Bus
from armlink.bus.message_port import as_frame
from armlink.bus.open import open_bus
from armlink.bus.port import ERROR, EXTENDED, REMOTE
from armlink.bus.sockets.multicast_port import message_in

GROUP = "239.74.163.47"
PORT = 45200 + os.getpid() % 1000


@contextmanager
def open_member(fd=True, channel=GROUP):
    options = {"port": PORT} if fd else {"port": PORT, "fd": False}
    bus = open_bus(None, Bus(interface="udp_multicast", channel=channel, options=options))
    try:
        yield bus
    finally:
        bus.shutdown()


@pytest.fixture
def stock():
    with can.Bus(GROUP, interface="udp_multicast", port=PORT) as bus:
        yield bus


@pytest.fixture
def member():
    with open_member() as bus:
        yield bus


@pytest.fixture
def port(member):
    return member.open_port()


def message(can_id=0x181, data=b"", fd=False, **fields):
    return can.Message(
        arbitration_id=can_id, data=data, is_extended_id=fields.pop("is_extended_id", False), is_fd=fd, **fields
    )


# ---- datagrams


messages = st.builds(
    lambda fd, extended, kind, raw, data, switch, indicator, stamp, channel: can.Message(
        timestamp=stamp,
        arbitration_id=raw & (0x1FFFFFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_remote_frame=kind == "remote" and not fd,
        is_error_frame=kind == "error",
        data=data[: 64 if fd else 8],
        is_fd=fd,
        bitrate_switch=fd and switch,
        error_state_indicator=fd and indicator,
        channel=channel,
    ),
    fd=st.booleans(),
    extended=st.booleans(),
    kind=st.sampled_from(["data", "data", "remote", "error"]),
    raw=st.one_of(st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF)),
    data=st.binary(max_size=64),
    switch=st.booleans(),
    indicator=st.booleans(),
    stamp=st.one_of(st.just(0.0), st.floats(0, 2e9), st.integers(0, 2**33)),
    channel=st.sampled_from([None, "vcan0", 3]),
)


def expected(sent):
    flags = EXTENDED * sent.is_extended_id | REMOTE * sent.is_remote_frame | ERROR * sent.is_error_frame
    data = bytes(sent.dlc) if sent.is_remote_frame else bytes(sent.data)
    return sent.arbitration_id | flags, data, sent.is_fd


def decode(datagram):
    found = message_in(datagram)
    return None if found is None else (*as_frame(found), found.is_fd)


@given(messages, st.randoms())
def test_every_message_of_python_can_is_understood_in_any_order_of_its_fields(sent, random):
    datagram = pack_message(sent)
    assert decode(datagram) == expected(sent)
    fields = list(msgpack.unpackb(datagram).items())
    random.shuffle(fields)
    assert decode(msgpack.packb(dict(fields))) == expected(sent)


@settings(max_examples=300)
@given(messages, st.data())
def test_a_changed_datagram_is_what_python_can_makes_of_it_or_nothing(sent, draw):
    datagram = bytearray(pack_message(sent))
    for _ in range(draw.draw(st.integers(1, 3))):
        datagram[draw.draw(st.integers(0, len(datagram) - 1))] = draw.draw(st.integers(0, 255))
    found = decode(bytes(datagram))
    if found is not None:
        assert found == expected(unpack_message(bytes(datagram), replace={"timestamp": 1.0}, check=True))


@given(
    st.one_of(
        st.binary(max_size=200),
        st.recursive(
            st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
            lambda inner: (
                st.lists(inner)
                | st.dictionaries(
                    st.sampled_from(["data", "dlc", "is_fd", "arbitration_id", "is_rx", "channel", "x"]), inner
                )
            ),
        ).map(msgpack.packb),
    )
)
def test_anything_else_is_no_frame_and_no_error(datagram):
    found = decode(datagram)
    assert found is None or isinstance(unpack_message(datagram, check=True), can.Message)


@pytest.mark.parametrize(
    "fields",
    [
        {"arbitration_id": 0x800, "is_extended_id": False},
        {"arbitration_id": -1},
        {"arbitration_id": 1.0},
        {"arbitration_id": True},
        {"data": bytes(9)},
        {"data": 10**9},
        {"data": "text"},
        {"data": b"12", "dlc": 3},
        {"is_fd": True, "data": bytes(65)},
        {"is_fd": 1},
        {"bitrate_switch": True},
        {"is_remote_frame": True, "is_error_frame": True},
        {"is_remote_frame": True, "is_fd": True},
        {"colour": "red"},
    ],
    ids=str,
)
def test_a_map_that_is_no_valid_message_is_no_frame(fields):
    assert decode(msgpack.packb(fields)) is None


# ---- on the network


def drain(port, wait=0.2):
    frames = []
    while (frame := port.receive(wait if not frames else 0.05)) is not None:
        frames.append(frame)
    return frames


@pytest.mark.parametrize("length", [0, 1, 8, 12, 64])
def test_python_can_hears_what_a_port_sends(port, stock, length):
    for each in [(can_id, bytes(range(length))) for can_id in (0x00, 0x80, 0x181, 0x7FF)]:
        port.send(*each)
    heard = [stock.recv(1.0) for _ in range(4)]
    assert [each.arbitration_id for each in heard] == [0x00, 0x80, 0x181, 0x7FF]
    for each in heard:
        assert bytes(each.data) == bytes(range(length))
        assert (each.is_fd, each.bitrate_switch, each.is_extended_id, each.is_error_frame) == (True, True, False, False)
        assert abs(each.timestamp - time.time()) < 5.0
    assert stock.recv(0) is None


def test_a_classical_bus_sends_classical_frames_and_does_not_hear_fd(stock):
    with open_member(fd=False) as bus:
        port = bus.open_port()
        port.send(0x201, b"abc")
        heard = stock.recv(1.0)
        assert (heard.is_fd, heard.bitrate_switch, bytes(heard.data)) == (False, False, b"abc")
        stock.send(message(0x181, bytes(12), fd=True))
        stock.send(message(0x182, b"ok"))
        assert drain(port) == [(0x182, b"ok")]


def test_a_port_hears_what_python_can_sends(port, stock):
    sent = [
        message(0x181, b"12345678"),
        message(0x05, b""),
        message(0x181, bytes(64), fd=True, bitrate_switch=True),
        message(0x12345, b"extended", is_extended_id=True),
        message(0x183, is_remote_frame=True, dlc=4),
        message(0x008, bytes(8), is_error_frame=True),
        message(0x7FF, b"end"),
    ]
    for each in sent:
        stock.send(each)
    assert drain(port) == [
        (0x181, b"12345678"),
        (0x05, b""),
        (0x181, bytes(64)),
        (0x80012345, b"extended"),
        (0x40000183, bytes(4)),
        (0x7FF, b"end"),
    ]
    assert port.errors == 1
    assert port.dropped == 0


def test_own_frames_are_left_out_and_equal_ones_of_others_are_not(port, stock):
    frame = (0x181, b"same")
    for _ in range(5):
        port.send(*frame)
        stock.send(message(*frame))
        stock.send(message(*frame))
    assert drain(port) == [frame] * 10
    stock.send(message(*frame))
    assert port.receive(1.0) == frame


def test_two_ports_hear_each_other_but_not_themselves(port):
    with open_member() as bus:
        other = bus.open_port()
        for each in [(0x80, b""), (0x201, b"a")]:
            port.send(*each)
        other.send(0x181, b"b")
        assert drain(other) == [(0x80, b""), (0x201, b"a")]
        assert drain(port) == [(0x181, b"b")]


def test_a_wait_lasts_its_time_whatever_echoes_come_meanwhile(port):
    for each in [(0x80, b"")] * 40:
        port.send(*each)
    start = time.monotonic()
    assert port.receive(0.1) is None
    assert time.monotonic() - start >= 0.1


def test_many_frames_pass(port):
    with open_member() as bus:
        other = bus.open_port()
        frames = [(can_id, bytes([can_id & 0xFF])) for can_id in range(197)]
        for each in frames:
            port.send(*each)
        assert drain(other) == frames


def test_other_groups_on_the_same_port_are_not_heard(port):
    with can.Bus("239.74.163.48", interface="udp_multicast", port=PORT) as elsewhere:
        elsewhere.send(message(0x181, b"other"))
        assert port.receive(0.1) is None


def test_a_node_answers_in_frames_as_it_hears(member, stock):
    port = member.open_port(as_node=True)
    stock.send(message(0x601, b"classic"))
    assert port.receive(1.0) == (0x601, b"classic")
    for each in [(0x581, b"1"), (0x20000008, bytes(8))]:
        port.send(*each)
    stock.send(message(0x601, b"fd", fd=True))
    assert port.receive(1.0) == (0x601, b"fd")
    for each in [(0x581, b"2"), (0x20000008, bytes(8))]:
        port.send(*each)
    heard = [each for each in (stock.recv(1.0) for _ in range(6)) if each.arbitration_id != 0x601]  # its own echoes
    assert [(each.is_fd, each.is_error_frame) for each in heard] == [
        (False, False),
        (False, True),
        (True, False),
        (False, True),
    ]


def test_datagrams_that_are_no_frames_are_ignored(port, stock):
    hostile = [
        b"",
        b"\xc1",
        b"\x91" * 900,
        msgpack.packb({"data": 10**9}),
        b"\xdf\xff\xff\xff\xff",
        pack_message(message(0x181, b"x"))[:-1],
        pack_message(message(0x181, b"x")) + b"\0",
        os.urandom(5000),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in hostile:
            sender.sendto(datagram, (GROUP, PORT))
        stock.send(message(0x181, b"x"))
        assert drain(port) == [(0x181, b"x")]
        for _ in range(1000):
            sender.sendto(b"flood", (GROUP, PORT))
    assert drain(port) == []


def test_a_full_queue_counts_what_it_lost(port):
    with open_member() as bus, open_member() as small:
        other, port = bus.open_port(), small.open_port()
        small.bus._multicast._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for each in [(0x181, bytes(8))] * 2000:
            other.send(*each)
        taken = len(drain(port))
        other.send(0x182, b"")
        taken += len(drain(port))
        assert taken + port.dropped == 2001
        assert port.dropped > 0


def test_a_listener_gets_the_kernel_s_times(stock):
    with open_member() as bus:
        port = bus.open_listening_port()
        before = time.monotonic()
        for can_id in range(200):
            stock.send(message(can_id, b"t"))
        after = time.monotonic()
        port.wait(1.0)
        time.sleep(0.05)
        frames = port.take_all()
        assert [(can_id, data) for _, can_id, data in frames] == [(can_id, b"t") for can_id in range(200)]
        times = [stamp for stamp, _, _ in frames]
        assert all(one <= other for one, other in itertools.pairwise(times))
        assert before - 0.002 <= times[0] <= times[-1] <= after + 0.002
        assert port.take_all() == []


def test_ipv6(monkeypatch):
    channel = "ff15:7079:7468:6f6e:6465:6d6f:6d63:6173"
    try:
        with open_member(channel=channel) as bus, can.Bus(channel, interface="udp_multicast", port=PORT) as stock:
            port = bus.open_port()
            port.send(0x181, b"six")
            stock.send(message(0x182, b"back"))
            assert bytes(stock.recv(1.0).data) == b"six"
            assert drain(port) == [(0x182, b"back")]
    except (can.CanError, OSError) as error:
        pytest.skip(f"no IPv6 multicast here: {error}")
