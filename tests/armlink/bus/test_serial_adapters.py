"""Serial USB-CAN adapters: bytes from their makers' programs, and ports on a pseudo-terminal."""

import os
import pty
import tty
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlink.arm_file import Bus
from armlink.bus.open import open_bus
from armlink.bus.port import EXTENDED
from armlink.bus.serial_adapters import DamiaoSerialBus, RobStrideSerialBus
from armlink.errors import ArmlinkError, BusFault

DAMIAO_ENABLE = bytes.fromhex("55aa1e03010000000a000000000100000000080000fffffffffffffffc00")
"""To drive 1, as Damiao's DM_CAN.py sends it."""
DAMIAO_REPLY = bytes.fromhex("aa11080b0000000180007ff7ff1b1c55")
"""From identifier 0Bh."""
ROBSTRIDE_DISABLE = bytes.fromhex("41542007e8540800000000000000000d0a")
ROBSTRIDE_REPLY = bytes.fromhex("4154100057ec08a6d4808c7fff01400d0a")
"""To drive 10 and from it, as a user logged MotorStudio (robstride_ros_sample, issue 1)."""


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The adapter's end of a pseudo-terminal, and the name of the host's."""
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    yield ours, os.ttyname(theirs)
    for each in (ours, theirs):
        try:
            os.close(each)
        except OSError:
            continue


def message(identifier: int, data: str, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=identifier, data=bytes.fromhex(data), is_extended_id=extended)


def test_bytes_of_damiao_s_program() -> None:
    assert DamiaoSerialBus.packet(message(1, "fffffffffffffffc")) == DAMIAO_ENABLE
    found = DamiaoSerialBus.take(bytearray(DAMIAO_REPLY))
    assert found is not None
    assert (found.arbitration_id, found.is_extended_id, bytes(found.data)) == (0xB, False, DAMIAO_REPLY[7:15])


def test_bytes_of_robstride_s_program() -> None:
    """Communication type 4 (disable) from host FDh to drive 10, and its feedback (type 2)."""
    assert RobStrideSerialBus.packet(message(0x0400FD0A, "00" * 8, extended=True)) == ROBSTRIDE_DISABLE
    found = RobStrideSerialBus.take(bytearray(ROBSTRIDE_REPLY))
    assert found is not None
    assert (found.arbitration_id, found.is_extended_id) == (0x02000AFD, True)
    assert bytes(found.data) == ROBSTRIDE_REPLY[7:15]


def test_an_error_of_the_bus_is_an_error_frame_and_an_echo_is_none() -> None:
    error, echo = bytearray(DAMIAO_REPLY), bytearray(DAMIAO_REPLY)
    error[1], echo[1] = 0x02, 0x12
    found = DamiaoSerialBus.take(echo + error)
    assert found is not None
    assert found.is_error_frame


@given(
    st.integers(0, 0x1FFFFFFF), st.booleans(), st.booleans(), st.binary(max_size=8), st.binary(max_size=20), st.data()
)
def test_robstride_frames_come_back_whatever_surrounds_them(identifier, extended, remote, data, rubbish, draw) -> None:
    """In pieces of any size, after rubbish that does not begin like a frame."""
    identifier = identifier if extended else identifier & 0x7FF
    sent = can.Message(arbitration_id=identifier, is_extended_id=extended, is_remote_frame=remote, dlc=len(data))
    if not remote:
        sent.data = bytearray(data)
    stream = rubbish.replace(b"A", b"") + RobStrideSerialBus.packet(sent) + b"OK\r\n" * 3
    cut = draw.draw(st.integers(0, len(stream)))
    received = bytearray(stream[:cut])
    found = RobStrideSerialBus.take(received)
    received += stream[cut:]
    found = found or RobStrideSerialBus.take(received)
    assert found is not None
    assert found.equals(sent, timestamp_delta=None, check_channel=False)
    assert RobStrideSerialBus.take(received) is None


@given(st.lists(st.binary(max_size=40), max_size=8))
def test_rubbish_raises_nothing(pieces) -> None:
    for kind in (DamiaoSerialBus, RobStrideSerialBus):
        received = bytearray()
        for piece in pieces:
            received += piece
            while kind.take(received) is not None:
                pass
        assert len(received) < 17


@pytest.mark.parametrize(
    ("interface", "hello", "heard", "frame", "sent", "packet"),
    [
        ("damiao_serial", b"", DAMIAO_REPLY, (0xB, DAMIAO_REPLY[7:15]), (1, "fffffffffffffffc"), DAMIAO_ENABLE),
        (
            "robstride_serial",
            b"AT+AT\r\n",
            ROBSTRIDE_REPLY,
            (0x02000AFD | EXTENDED, ROBSTRIDE_REPLY[7:15]),
            (0x0400FD0A | EXTENDED, "00" * 8),
            ROBSTRIDE_DISABLE,
        ),
    ],
)
def test_a_port_on_a_pseudo_terminal(terminal, interface, hello, heard, frame, sent, packet) -> None:
    adapter, name = terminal
    bus = open_bus(f"{interface}:{name}", Bus())
    try:
        port = bus.open_port()
        assert os.read(adapter, 100) == hello if hello else True
        assert port.receive(0.0) is None
        port.send(sent[0], bytes.fromhex(sent[1]))
        assert os.read(adapter, 100) == packet
        os.write(adapter, heard[:5])
        assert port.receive(0.01) is None
        os.write(adapter, heard[5:] + heard)
        assert [port.receive(1.0), port.receive(1.0), port.receive(0.0)] == [frame, frame, None]
    finally:
        bus.shutdown()


def test_an_adapter_that_is_unplugged_is_a_fault_of_the_bus(terminal) -> None:
    adapter, name = terminal
    bus = open_bus(f"damiao_serial:{name}", Bus())
    try:
        port = bus.open_port()
        os.close(adapter)
        with pytest.raises(BusFault, match=rf"^bus damiao_serial:{name}: cannot receive: "):
            [port.receive(0.1) for _ in range(3)]
    finally:
        bus.shutdown()


def test_one_line_for_what_is_not_there(tmp_path: Path) -> None:
    for interface in ("damiao_serial", "robstride_serial"):
        with pytest.raises(ArmlinkError, match=rf"^bus {interface}:{tmp_path}/none: cannot open it: ") as caught:
            open_bus(f"{interface}:{tmp_path}/none", Bus())
        assert "\n" not in str(caught.value)
