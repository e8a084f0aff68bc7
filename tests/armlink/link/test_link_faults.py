"""Faults: what is detected, what the joints do, and what the user reads."""

import struct

import numpy as np
import pytest

from armlink.errors import BusFault
from armlink.link.types import Command

QUICK_STOP, FAULT, SWITCH_ON_DISABLED = 0x07, 0x08, 0x40


def hold(n=3):
    return Command(np.full(n, 8, np.int8), np.zeros(n), np.zeros(n))


def cycles_until_fault(link, limit=100):
    for cycle in range(limit):
        try:
            link.cycle(hold())
        except BusFault as fault:
            return cycle, str(fault)
    raise AssertionError(f"no fault in {limit} cycles")


def statuses(bus):
    return [node.status for node in bus.nodes.values()]


def test_an_emergency_is_named_and_stops_all(enabled, bus):
    bus.out.append((0x82, struct.pack("<HB5x", 0x8611, 0x20)))
    cycle, says = cycles_until_fault(enabled)
    assert cycle == 0
    assert says == "joint_2: emergency 8611h, following error (error register 20h)"
    assert statuses(bus) == [QUICK_STOP] * 3


def test_an_error_reset_message_is_no_fault(enabled, bus):
    bus.out.append((0x82, bytes(8)))
    enabled.cycle(hold())


def test_a_restarted_node_is_named(enabled, bus):
    bus.out.append((0x703, b"\x00"))
    cycle, says = cycles_until_fault(enabled)
    assert cycle == 0
    assert says.startswith("joint_3: its drive has restarted (boot-up message): calibration and mode are lost")
    assert statuses(bus)[:2] == [QUICK_STOP] * 2


def test_a_node_that_leaves_operational_is_named(enabled, bus):
    bus.out.append((0x701, b"\x7f"))
    assert cycles_until_fault(enabled)[1] == "joint_1: its NMT state is pre-operational, expected operational"


def test_a_drive_fault_is_named(enabled, bus):
    bus.nodes[1].status = FAULT
    bus.out.append((0x381, struct.pack("<Hb", FAULT, 8)))
    assert (
        cycles_until_fault(enabled)[1]
        == 'joint_1: state "fault" (status word 0x0008), expected "operation enabled": read its error code 603Fh'
    )


def test_lost_readings_are_nan_with_their_age_then_a_fault(enabled, bus):
    bus.nodes[2].no_tpdo = True
    sample = enabled.cycle(hold())
    assert np.isnan(sample.position[1])
    assert np.isnan(sample.torque[1])
    assert np.isfinite(sample.position[[0, 2]]).all()
    assert sample.age == pytest.approx([0, 0.004, 0])
    assert enabled.cycle(hold()).age[1] == pytest.approx(0.008)
    cycle, says = cycles_until_fault(enabled)
    assert cycle == 23  # 26 cycles of 4 ms after the last reading: the first beyond the 100 ms deadline
    assert says == "joint_2: no reading for 104 ms, limit 100 ms"
    assert statuses(bus) == [QUICK_STOP] * 3
    assert enabled.stats.missed >= 26


def test_a_reading_that_comes_back_is_fresh_again(enabled, bus):
    bus.nodes[2].no_tpdo = True
    for _ in range(20):
        enabled.cycle(hold())
    bus.nodes[2].no_tpdo = False
    assert enabled.cycle(hold()).age.tolist() == [0, 0, 0]


def test_a_reading_that_missed_its_cycle_is_not_passed_off_as_new(enabled, bus):
    bus.nodes[2].no_tpdo = True
    enabled.cycle(hold())
    bus.out.append((0x182, struct.pack("<ii", 777, 777)))  # comes after its cycle is over
    sample = enabled.cycle(hold())
    assert np.isnan(sample.position[1])


def test_a_reading_that_comes_twice_does_not_hide_a_lost_one(enabled, bus):
    bus.nodes[2].no_tpdo = True
    sync = bus._sync

    def twice(node):
        sync(node)
        if node.node == 1:
            bus.out.append((0x181, struct.pack("<ii", node.position, node.torque)))

    bus._sync = twice
    before = enabled.stats.missed
    assert np.isnan(enabled.cycle(hold()).position[1])
    assert enabled.stats.missed == before + 1


@pytest.mark.parametrize("data", [b"", b"\x01", bytes(7)])
def test_frames_of_a_wrong_length_are_counted_and_dropped(enabled, bus, data):
    sync = bus._sync

    def short(node):
        sync(node)
        if node.node == 3:
            bus.out = type(bus.out)(frame for frame in bus.out if frame[0] != 0x183)
            bus.out.append((0x183, data))

    bus._sync = short
    sample = enabled.cycle(hold())
    assert np.isnan(sample.position[2])
    assert enabled.stats.errors == 1


def test_frames_of_strangers_are_ignored(enabled, bus):
    rng = np.random.default_rng(5)
    bases = (0x80, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x500, 0x580, 0x600, 0x700)
    ours = {0x000, 0x080, 0x77F, 0x7E5, *(base + node for base in bases for node in (1, 2, 3))}
    strangers = sorted(set(range(0x800)) - ours)
    for start in range(0, len(strangers), 20):
        for can_id in strangers[start : start + 20]:
            bus.out.append((can_id, rng.bytes(int(rng.integers(0, 9)))))
        enabled.cycle(hold())


def test_the_same_link_can_be_enabled_again_after_a_fault(enabled, bus):
    bus.out.append((0x82, struct.pack("<HB5x", 0x7300, 0x20)))
    cycles_until_fault(enabled)
    enabled.enable()
    enabled.cycle(hold())


def test_a_bus_that_dies_leaves_with_the_first_error(link, bus):
    link.start()
    link.enable()

    def dead(can_id, data):
        raise BusFault("bus fake: cannot send: network is down")

    link._loop._port.send = dead
    with pytest.raises(BusFault, match="network is down"):
        link.cycle(hold())
