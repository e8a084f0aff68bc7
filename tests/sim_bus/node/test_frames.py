"""Bytes on the wire, worked out from CiA 301 and the joint's default mapping."""

import struct
import zlib

import numpy as np
import pytest
from rig import UNIT, Rig, one_joint

from sim_bus.truth import Truth

ABORT = 0x80


@pytest.fixture
def rig() -> Rig:
    return Rig(one_joint())


def abort_code(answer: bytes) -> int:
    assert answer[0] == ABORT
    return int(struct.unpack("<I", answer[4:])[0])


def test_every_node_boots_into_pre_operational() -> None:
    assert Rig("sarcos").boot == [(0x700 + node, b"\0") for node in range(1, 8)]


def test_sdo_expedited_upload_of_the_device_type(rig: Rig) -> None:
    assert rig.sdo(5, bytes.fromhex("4000100000000000")) == bytes.fromhex("4300100092010200")


def test_sdo_upload_of_two_bytes_and_of_rated_torque_in_millinewtonmetres(rig: Rig) -> None:
    assert rig.sdo(5, bytes.fromhex("4041600000000000")) == bytes.fromhex("4b41600050020000")  # switch-on disabled
    assert rig.sdo(5, bytes.fromhex("4076600000000000")) == bytes.fromhex("4376600010270000")  # 10000 mN·m


def test_sdo_segmented_upload_of_the_device_name(rig: Rig) -> None:
    assert rig.sdo(5, bytes.fromhex("4008100000000000")) == bytes.fromhex("410810000d000000")  # 13 bytes follow
    first, second = rig.sdo(5, bytes([0x60, *bytes(7)])), rig.sdo(5, bytes([0x70, *bytes(7)]))
    assert first == b"\x00armlink"
    assert second == b"\x13 joint" + b"\0"


def test_sdo_expedited_download_is_read_back(rig: Rig) -> None:
    assert rig.sdo(5, bytes.fromhex("2b1710001400 0000")) == bytes.fromhex("6017100000000000")
    assert rig.read(5, 0x1017) == b"\x14\0"


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        ("4000300000000000", 0x06020000),  # no such object
        ("4018100900000000", 0x06090011),  # no such sub-index
        ("2341600000000000", 0x06010002),  # read-only
        ("2317100000000000", 0x06070010),  # wrong length
        ("2f29100107000000", 0x06090030),  # value out of range
        ("2310100100000000", 0x08000020),  # store without its signature
    ],
)
def test_sdo_refuses_with_the_code_of_the_standard(rig: Rig, request_bytes: str, code: int) -> None:
    assert abort_code(rig.sdo(5, bytes.fromhex(request_bytes))) == code


def test_nothing_is_sent_cyclically_before_nmt_start(rig: Rig) -> None:
    assert rig.send(0x80, b"") == []


def test_default_tpdos_at_sync_hold_position_and_torque_sensor(rig: Rig) -> None:
    rig.start(8)
    true_position, true_torque = rig.arm.plant.position[0], rig.arm.plant.link_torque[0]
    position, torque = struct.unpack("<ii", dict(rig.cycle())[0x185])
    assert position == pytest.approx(true_position / UNIT, abs=1)
    assert torque == pytest.approx(true_torque * 1e6, abs=20)


def test_status_torque_and_velocity_come_at_every_fourth_sync(rig: Rig) -> None:
    rig.start(8)
    seen = [any(can_id == 0x285 for can_id, _ in rig.cycle()) for _ in range(8)]
    assert sum(seen) == 2
    assert seen[:4] == seen[4:]


def test_status_is_sent_when_it_changes_and_only_then(rig: Rig) -> None:
    rig.start(8)
    rig.run(0.1)
    rig.word = 0x02
    status = [data for can_id, data in rig.cycle() if can_id == 0x385]
    assert [(word & 0x6F, mode) for word, mode in (struct.unpack("<Hb", data) for data in status)] == [(0x07, 8)]
    assert not [data for can_id, data in rig.cycle() if can_id == 0x385]


def test_heartbeat_is_produced_with_its_period_and_state(rig: Rig) -> None:
    rig.write(5, 0x1017, 0, struct.pack("<H", 100))
    rig.arm.advance(1.0)
    assert rig.drain() == [(0x705, b"\x7f")] * 10
    rig.send(0, b"\x01\x05")
    rig.drain()
    rig.arm.advance(0.1)
    assert (0x705, b"\x05") in rig.drain()


def test_nmt_stop_and_reset(rig: Rig) -> None:
    rig.start(8)
    rig.send(0, b"\x02\x05")
    assert rig.send(0x80, b"") == []
    assert rig.send(0x605, bytes.fromhex("4000100000000000")) == []  # no SDO while stopped
    assert (0x705, b"\0") in rig.send(0, b"\x81\x00")
    assert rig.status(5) & 0x4F == 0x40


def test_tpdo_is_remapped_by_the_procedure_of_the_standard_and_read_back(rig: Rig) -> None:
    assert abort_code(rig.write(5, 0x1A00, 0, b"\0")) == 0x08000022  # the PDO is still valid
    rig.write(5, 0x1800, 1, struct.pack("<I", 0xC0000185))
    rig.write(5, 0x1A00, 0, b"\0")
    rig.write(5, 0x1A00, 1, struct.pack("<I", 0x21000120))
    rig.write(5, 0x1A00, 2, struct.pack("<I", 0x60410010))
    assert abort_code(rig.write(5, 0x1A00, 3, struct.pack("<I", 0x60720020))) == 0x06040041  # 6072h has 16 bits
    rig.write(5, 0x1A00, 3, struct.pack("<I", 0x60640020))
    assert abort_code(rig.write(5, 0x1A00, 0, b"\3")) == 0x06040042  # ten bytes
    assert rig.write(5, 0x1A00, 0, b"\2")[0] == 0x60
    rig.write(5, 0x1800, 1, struct.pack("<I", 0x40000195))
    assert rig.read(5, 0x1A00, 0) == b"\2"
    assert rig.read(5, 0x1A00, 1) == struct.pack("<I", 0x21000120)
    rig.send(0, b"\x01\x05")
    frames = dict(rig.send(0x80, b""))
    assert 0x185 not in frames
    torque, status = struct.unpack("<iH", frames[0x195])
    assert status & 0x4F == 0x40
    assert torque == pytest.approx(rig.arm.plant.link_torque[0] * 1e6, abs=2e5)


def test_rpdo_can_carry_the_mode_and_takes_effect_at_sync(rig: Rig) -> None:
    rig.write(5, 0x1400, 1, struct.pack("<I", 0x80000205))
    rig.write(5, 0x1600, 0, b"\0")
    for place, entry in enumerate((0x60400010, 0x60600008, 0x60710010), start=1):
        rig.write(5, 0x1600, place, struct.pack("<I", entry))
    rig.write(5, 0x1600, 0, b"\3")
    rig.write(5, 0x1400, 1, struct.pack("<I", 0x205))
    rig.send(0, b"\x01\x00")
    rig.send(0x205, struct.pack("<Hbh", 6, 10, 0))
    assert rig.read(5, 0x6061) == b"\0"
    rig.send(0x80, b"")
    assert rig.read(5, 0x6061) == b"\x0a"


def test_a_short_rpdo_is_refused_with_an_emergency(rig: Rig) -> None:
    rig.start(8)
    assert rig.send(0x205, b"\x0f\0") == [(0x85, bytes.fromhex("1082100208000000"))]


def test_a_calibration_record_comes_into_force_only_with_its_crc(rig: Rig) -> None:
    content = struct.pack("<ffII", 1.25, -0.5, 77, 1_700_000_000)
    for sub, data in zip((4, 5, 7, 8), (content[:4], content[4:8], content[8:12], content[12:]), strict=True):
        rig.write(5, 0x2100, sub, data)
    rig.write(5, 0x2100, 9, struct.pack("<I", zlib.crc32(content) ^ 1))
    assert abort_code(rig.write(5, 0x2100, 6, b"\1")) == 0x06090030
    assert rig.read(5, 0x2100, 2) == struct.pack("<f", 1.0)
    rig.write(5, 0x2100, 9, struct.pack("<I", zlib.crc32(content)))
    assert rig.read(5, 0x2100, 6) == b"\0"
    assert rig.write(5, 0x2100, 6, b"\1")[0] == 0x60
    assert rig.read(5, 0x2100, 6) == b"\1"
    assert rig.read(5, 0x2100, 2) + rig.read(5, 0x2100, 3) == content[:8]


@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (np.nan, 0.0), (np.inf, 0.0), (1.1, np.nan), (1.1, np.inf)])
def test_a_calibration_record_of_no_use_is_refused(rig: Rig, gain: float, offset: float) -> None:
    content = struct.pack("<ffII", gain, offset, 77, 1)
    for sub, data in zip((4, 5, 7, 8), (content[:4], content[4:8], content[8:12], content[12:]), strict=True):
        rig.write(5, 0x2100, sub, data)
    rig.write(5, 0x2100, 9, struct.pack("<I", zlib.crc32(content)))
    assert abort_code(rig.write(5, 0x2100, 6, b"\1")) == 0x06090030
    assert rig.read(5, 0x2100, 2) == struct.pack("<f", 1.0)


@pytest.mark.parametrize(("sub", "kept"), [(1, False), (2, True), (4, False)])
def test_restoring_all_or_the_devices_own_parameters_forgets_the_record(rig: Rig, sub: int, kept: bool) -> None:
    content = struct.pack("<ffII", 1.25, -0.5, 77, 1)
    for place, data in zip((4, 5, 7, 8), (content[:4], content[4:8], content[8:12], content[12:]), strict=True):
        rig.write(5, 0x2100, place, data)
    rig.write(5, 0x2100, 9, struct.pack("<I", zlib.crc32(content)))
    rig.write(5, 0x2100, 6, b"\1")
    assert rig.write(5, 0x1010, 4, b"save")[0] == 0x60
    assert rig.write(5, 0x1011, sub, b"load")[0] == 0x60
    rig.send(0, b"\x81\x05")
    assert rig.read(5, 0x2100, 2) == struct.pack("<f", 1.25 if kept else 1.0)


def test_the_reading_is_corrected_by_the_record_in_force_and_the_record_survives_only_if_stored() -> None:
    arm = one_joint(sensors={"gain": [1.25], "offset": [-0.5], "noise": [0.0], "bits": 20})
    rig = Rig(arm, Truth.of(arm))
    rig.arm.advance(0.1)
    torque = rig.arm.plant.link_torque[0]

    def reading() -> float:
        return struct.unpack("<i", rig.read(5, 0x2100, 1))[0] * 1e-6

    def install(gain: float, offset: float) -> None:
        content = struct.pack("<ffII", gain, offset, 1, 2)
        for sub, data in zip((4, 5, 7, 8), (content[:4], content[4:8], content[8:12], content[12:]), strict=True):
            rig.write(5, 0x2100, sub, data)
        rig.write(5, 0x2100, 9, struct.pack("<I", zlib.crc32(content)))
        assert rig.write(5, 0x2100, 6, b"\1")[0] == 0x60

    assert reading() == pytest.approx(1.25 * torque - 0.5, abs=1e-4)
    install(1.25, -0.5)
    rig.arm.advance(0.01)
    assert reading() == pytest.approx(torque, abs=1e-3)
    rig.send(0, b"\x81\x05")
    assert rig.read(5, 0x2100, 2) == struct.pack("<f", 1.0)
    install(1.25, -0.5)
    assert rig.write(5, 0x1010, 4, b"save")[0] == 0x60
    rig.send(0, b"\x81\x05")
    assert rig.read(5, 0x2100, 2) == struct.pack("<f", 1.25)


def test_two_runs_with_one_seed_send_the_same_frames_and_another_seed_does_not() -> None:
    def frames(seed: int) -> list[tuple[int, bytes]]:
        rig = Rig("sarcos", seed=seed)
        rig.start(8)
        rig.select(10)
        rig.torque = np.array([50, -50, 30, 30, -30, 20, 20])
        return [frame for _ in range(50) for frame in rig.cycle()]

    assert frames(1) == frames(1)
    assert frames(1) != frames(2)
