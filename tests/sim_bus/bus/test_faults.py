"""Faults between the simulated arm and its bus, frame by frame; what they lead to is in tests/faults."""

import struct

import can
import pytest
from rig import Rig

from armlink.drives.canopen.cia402 import DriveState
from sim_bus.bus.lock_step import LockStepBus

CSP = 8


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.start(CSP)
    return rig


def ids(frames: list[tuple[int, bytes]]) -> list[int]:
    return [can_id for can_id, _ in frames]


def test_without_a_fault_nothing_stands_between_bus_and_arm(rig: Rig) -> None:
    assert rig.bus.line is rig.arm


def test_a_silent_node_neither_sends_nor_hears_and_comes_back(rig: Rig) -> None:
    rig.bus.inject("node.silent:joint_3:0.1")
    assert 0x183 not in ids(rig.cycle())
    assert rig.send(0x603, bytes.fromhex("4000100000000000")) == []
    assert 0x182 in ids(rig.cycle())
    rig.run(0.2)
    assert 0x183 in ids(rig.cycle())


def test_a_reboot_loses_mode_and_unsaved_calibration(rig: Rig) -> None:
    rig.write(3, 0x2100, 4, struct.pack("<f", 1.5))
    rig.bus.inject("node.reboot:joint_3")
    assert (0x703, b"\0") in rig.drain()
    assert rig.arm.drives.state[2] is DriveState.SWITCH_ON_DISABLED
    assert struct.unpack("<f", rig.read(3, 0x2100, 4))[0] == 1.0
    assert rig.read(3, 0x6061) == b"\0"
    assert rig.arm.drives.state[1] is DriveState.ENABLED


def test_a_fault_waits_for_its_time(rig: Rig) -> None:
    rig.bus.inject(f"node.silent:joint_3@{rig.arm.time + 0.1}")
    assert 0x183 in ids(rig.cycle())
    rig.run(0.12)
    assert 0x183 not in ids(rig.cycle())


def test_babbling_and_storms_come_at_their_rate(rig: Rig) -> None:
    rig.bus.inject("node.babbling:joint_1:1000")
    rig.bus.inject("emcy.storm:joint_2:500")
    frames = [frame for _ in range(250) for frame in rig.cycle()]
    assert ids(frames).count(0x001) == pytest.approx(1000, abs=2)
    assert frames.count((0x82, struct.pack("<HB5x", 0x7305, 0x21))) == pytest.approx(500, abs=2)


def test_a_share_of_frames_is_short_or_destroyed(rig: Rig) -> None:
    rig.bus.inject("frame.short:joint_1:0.5")
    rig.bus.inject("frame.corrupt:joint_2:0.5")
    rig.position[:] = 0
    frames = []
    for _ in range(200):
        rig.bus.put(0x80, b"")
        frames += rig.drain()
    short = [data for can_id, data in frames if can_id == 0x181 and len(data) == 3]
    assert len(short) == pytest.approx(100, abs=30)
    assert ids(frames).count(0x182) == pytest.approx(100, abs=30)
    assert rig.bus.errors == pytest.approx(100 + 25, abs=45)  # TPDO2, each fourth cycle, is struck as well


def test_sdo_requests_are_aborted_or_stay_unanswered(rig: Rig) -> None:
    rig.bus.inject("sdo.abort:joint_1")
    rig.bus.inject("sdo.timeout:joint_2")
    assert rig.sdo(1, bytes.fromhex("4000100000000000")) == bytes.fromhex("8000100022000008")
    assert rig.send(0x602, bytes.fromhex("4000100000000000")) == []


def test_a_refused_mode_is_not_displayed(rig: Rig) -> None:
    rig.bus.inject("mode.refused:joint_1:10")
    rig.select(10)
    rig.cycle()
    assert rig.read(1, 0x6061) == b"\0"
    assert rig.read(2, 0x6061) == b"\x0a"


def test_a_python_can_client_gets_error_frames_and_cannot_send_while_bus_off() -> None:
    with LockStepBus("sarcos") as bus:
        while bus.recv(0) is not None:
            pass
        bus.inject("bus.off::0.1")
        error = bus.recv(0)
        assert error.is_error_frame
        assert error.arbitration_id == 0x40
        with pytest.raises(can.CanOperationError, match="bus-off"):
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        restarted = bus.recv(0.2)
        assert restarted.is_error_frame
        assert restarted.arbitration_id == 0x100
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
