"""A host that dies: heartbeat, RPDO deadline and SYNC are watched on the device, and 6007h decides what happens."""

import struct

import pytest
from rig import Rig, one_joint

HOST = 0x7E


def running(option: int = 3, **objects: int) -> Rig:
    rig = Rig(one_joint())
    rig.write(5, 0x6007, 0, struct.pack("<h", option))
    if "heartbeat" in objects:
        rig.write(5, 0x1016, 1, struct.pack("<I", HOST << 16 | objects["heartbeat"]))
    if "deadline" in objects:
        rig.write(5, 0x1400, 5, struct.pack("<H", objects["deadline"]))
    if "period" in objects:
        rig.write(5, 0x1006, 0, struct.pack("<I", objects["period"]))
    rig.start(10)
    rig.run(0.1)
    return rig


def cycles_with_heartbeat(rig: Rig, seconds: float) -> None:
    for _ in range(round(seconds / 0.004)):
        rig.bus.put(0x700 + HOST, b"\5")
        rig.cycle()


@pytest.mark.parametrize(("option", "status"), [(0, 0x27), (1, 0x08), (2, 0x40), (3, 0x07)])
def test_a_lost_heartbeat_does_what_6007_says(option: int, status: int) -> None:
    rig = running(option, heartbeat=50)
    cycles_with_heartbeat(rig, 0.2)
    assert rig.status(5) & 0x6F == 0x27
    rig.arm.advance(0.06)
    frames = rig.drain()
    assert (0x85, struct.pack("<HB5s", 0x8130, 0x11, bytes([HOST]))) in frames
    assert rig.status(5) & (0x4F if status in (0x08, 0x40) else 0x6F) == status


def test_heartbeats_of_others_do_not_stand_for_the_hosts() -> None:
    rig = running(3, heartbeat=50)
    cycles_with_heartbeat(rig, 0.1)
    for _ in range(20):
        rig.bus.put(0x700 + HOST + 1, b"\5")
        rig.cycle()
    assert rig.status(5) & 0x6F == 0x07


def test_the_consumer_is_armed_by_the_first_heartbeat_only() -> None:
    rig = running(heartbeat=50)
    rig.arm.advance(1.0)
    assert rig.status(5) & 0x6F == 0x27


def test_quick_stop_holds_the_position_where_it_came_to_rest() -> None:
    rig = running(heartbeat=50)
    cycles_with_heartbeat(rig, 0.1)
    rig.arm.advance(0.06)
    rig.arm.advance(1.0)
    before = rig.arm.plant.position[0]
    rig.arm.advance(1.0)
    assert rig.arm.plant.position[0] == pytest.approx(before, abs=1e-3)
    assert rig.status(5) & 0x6F == 0x07


def test_a_quick_stop_while_pressing_on_a_stop_never_raises_the_torque() -> None:
    rig = running(heartbeat=50)
    for _ in range(400):
        rig.torque = rig.torque + 1
        rig.bus.put(0x700 + HOST, b"\5")
        rig.cycle()
    pressed = rig.arm.plant.motor_torque[0]
    rig.arm.advance(1.0)
    assert rig.status(5) & 0x6F == 0x07
    assert abs(rig.arm.plant.motor_torque[0]) <= pressed + 0.05


@pytest.mark.parametrize(("watch", "code"), [({"deadline": 20}, 0x8250), ({"period": 4000}, 0x8700)])
def test_missing_rpdos_and_missing_syncs_are_noticed(watch: dict[str, int], code: int) -> None:
    rig = running(**watch)
    assert rig.status(5) & 0x6F == 0x27
    rig.arm.advance(0.05)
    codes = [struct.unpack("<H", data[:2])[0] for can_id, data in rig.drain() if can_id == 0x85]
    assert codes == [code]
    assert rig.status(5) & 0x6F == 0x07
    assert struct.unpack("<H", rig.read(5, 0x603F))[0] == code


def test_leaving_operational_stops_an_enabled_drive() -> None:
    rig = running()
    rig.send(0, b"\x80\x05")
    assert rig.status(5) & 0x6F == 0x07


def test_the_error_history_holds_the_latest_first_and_reset_clears_it() -> None:
    rig = running(heartbeat=50)
    cycles_with_heartbeat(rig, 0.1)
    rig.arm.advance(0.1)
    assert rig.read(5, 0x1003, 0) == b"\1"
    assert struct.unpack("<I", rig.read(5, 0x1003, 1))[0] & 0xFFFF == 0x8130
    assert rig.read(5, 0x1001)[0] & 1
    rig.word = 0x00
    rig.drain()
    assert (0x85, bytes(8)) in rig.cycle()
    assert rig.read(5, 0x1003, 0) == b"\0"
