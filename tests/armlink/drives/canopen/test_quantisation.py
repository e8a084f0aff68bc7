"""Orders become RPDOs: rounding never leads out of a limit, and the bytes say what was ordered."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.drives.canopen.cyclic.commands import CommandFrames
from armlink.drives.canopen.cyclic.wire import Wire
from armlink.drives.canopen.faults import JointStates
from armlink.drives.canopen.profile import OURS
from armlink.drives.canopen.units import Units
from armlink.drives.orders import Limits, Mode, Order, Power

UNIT = Units(0.04, 2 * math.pi / 2**20, 2 * math.pi / 2**20, 1e-6)


def drives(lower=-2.0, upper=2.0, unit=UNIT):
    found = CommandFrames(JointStates(("joint_1",)), host=127, beat_every=0.05, period=0.004)
    found.use([Wire(1, OURS, unit, Limits(30.0, 200.0, 1.0, lower, upper, 0.1, 0.004))])
    return found


def wire(found, torque=0.0, position=0.0, mode=Mode.POSITION):
    order = Order(Power.ON, False, int(mode), position, 0.0, torque, 0.0, 0.0)
    return struct.unpack("<Hhi", dict(found.frames([order], 0.0))[0x201])


def test_torque_is_rounded_towards_zero():
    assert wire(drives(), 8.3)[1] == 207
    assert wire(drives(), -8.3)[1] == -207
    assert wire(drives(), 30.0)[1] == 750


def test_positions_are_rounded_into_the_window():
    assert wire(drives(), position=2.0)[2] == math.floor(2.0 / UNIT.position)
    assert wire(drives(), position=-2.0)[2] == math.ceil(-2.0 / UNIT.position)
    odd = drives(1.4 * UNIT.position, 2.6 * UNIT.position)  # at the very ends, whose nearest user unit lies outside
    assert wire(odd, position=1.4 * UNIT.position)[2] == 2
    assert wire(odd, position=2.6 * UNIT.position)[2] == 2


def test_positions_beyond_what_a_frame_carries_are_clipped():
    assert wire(drives(), position=1e6)[2] == 2**31 - 1
    assert wire(drives(), position=-1e6)[2] == -(2**31)


@settings(max_examples=200, deadline=None)
@given(st.floats(-30, 30), st.floats(-2, 2), st.sampled_from([2**20, 2**16, 360_000]))
def test_the_bytes_say_what_was_ordered(torque, position, counts):
    unit = Units(0.04, 2 * math.pi / counts, 2 * math.pi / counts, 1e-6)
    found = drives(unit=unit)
    word, _, _ = wire(found, torque, position)
    sent = found.sent(0)
    assert word == 0x0F
    assert sent.power is Power.ON
    assert abs(sent.torque) <= abs(torque) * (1 + 1e-12)  # 35 steps of 0.04 are 1.4000000000000001
    assert abs(torque) < abs(sent.torque) + 0.04 * (1 + 1e-9)
    assert abs(sent.position - position) <= unit.position * (1 + 1e-9)
    assert -2.0 <= sent.position <= 2.0


@pytest.mark.parametrize(("power", "word"), [(Power.OFF, 0x00), (Power.STOPPED, 0x02), (Power.ON, 0x0F)])
def test_power_is_the_control_word(power, word):
    found = drives()
    order = Order(power, False, 0, 0.0, 0.0, 0.0, 0.0, 0.0)
    data = dict(found.frames([order], 0.0))[0x201]
    assert struct.unpack_from("<H", data)[0] == word
    assert found.sent(0).power is power


def test_a_mode_is_selected_once_before_its_first_command():
    found = drives()
    orders = [Order(Power.ON, False, int(mode), 0.0, 0.0, 0.0, 0.0, 0.0) for mode in (8, 8, 10, 10, 8)]
    sent = [[can_id for can_id, _ in found.frames([order], 0.0) if can_id in (0x201, 0x301)] for order in orders]
    assert sent == [[0x301, 0x201], [0x201], [0x301, 0x201], [0x201], [0x301, 0x201]]


def test_a_joint_without_an_order_gets_no_frame():
    found = drives()
    assert all(can_id != 0x201 for can_id, _ in found.frames([None], 0.0))
    assert found.sent(0) is None
