"""The gate: whatever comes, no wire value exceeds a limit."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.gate import OFF, POSITION, TORQUE, JointLimits, is_fresh, pass_gate, start_from

INT16, INT32 = 2**15, 2**31
anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
modes = st.sampled_from([OFF, POSITION, TORQUE, 1, 9, -1])


@st.composite
def limits(draw):
    rated = draw(st.floats(0.5, 500))
    unit = rated / 1000
    lower = draw(st.floats(-7, 6.9))
    return JointLimits(
        max_torque=rated * draw(st.floats(0.01, 3)),
        torque_step=draw(st.floats(1e-4, 10)),
        position_step=draw(st.floats(1e-6, 0.1)),
        lower=lower,
        upper=lower + draw(st.floats(0.01, 7)),
        torque_unit=unit,
        position_unit=2 * math.pi / draw(st.sampled_from([2**20, 2**16, 360_000])),
    )


readings = st.one_of(st.just(math.nan), st.floats(-20, 20))
cycles = st.lists(st.tuples(modes, anything, anything, readings, readings, st.booleans()), min_size=1, max_size=20)


@settings(max_examples=400, deadline=None)
@given(limits(), st.floats(-20, 20), st.floats(-20, 20), cycles)
def test_no_frame_exceeds_a_limit_whoever_calls(limits, torque, position, cycles):
    held = start_from(limits, torque, position)
    for mode, wanted_torque, wanted_position, produced, measured, fresh in cycles:
        passed = pass_gate(limits, mode, wanted_torque, wanted_position, held, produced, measured, fresh)
        assert abs(passed.torque_wire) * limits.torque_unit <= limits.max_torque * (1 + 1e-12)
        assert -INT32 <= passed.position_wire < INT32
        wants = wanted_torque if mode == TORQUE else wanted_position if mode == POSITION else 0.0
        assert passed.refused == (not fresh or mode not in (OFF, POSITION, TORQUE) or not math.isfinite(wants))
        if mode == TORQUE and held.mode == TORQUE and not passed.refused:
            change = abs(passed.torque_wire - held.torque_wire) * limits.torque_unit
            assert change <= limits.torque_step + limits.torque_unit * (1 + 1e-9)
        if mode == POSITION and not passed.refused:
            start = measured if held.mode != POSITION and math.isfinite(measured) else held.position
            moved = abs(passed.position_wire * limits.position_unit - start)
            assert moved <= limits.position_step + limits.position_unit
            target = passed.position_wire * limits.position_unit
            slack = 1e-9 * limits.position_unit
            assert min(limits.lower, start) - slack <= target + limits.position_unit * (start < limits.lower)
            assert target - limits.position_unit * (start > limits.upper) <= max(limits.upper, start) + slack
        if passed.refused:
            assert abs(passed.torque) <= limits.max_torque
            assert passed.torque == pytest.approx(max(-limits.max_torque, min(limits.max_torque, passed.torque)), abs=0)
        held = passed


LIMITS = JointLimits(30.0, 0.8, 0.004, -2.0, 2.0, 0.04, 2 * math.pi / 2**20)
START = start_from(LIMITS, 8.0, 0.5)


def gate(mode, torque=0.0, position=0.0, held=START, produced=8.0, measured=0.5, fresh=True, limits=LIMITS):
    return pass_gate(limits, mode, torque, position, held, produced, measured, fresh)


def test_the_first_torque_frame_is_one_step_from_the_torque_now_produced():
    passed = gate(TORQUE, torque=-30.0)
    assert passed.torque == pytest.approx(7.2)
    assert passed.torque_wire == 180
    assert gate(TORQUE, torque=8.3).torque_wire == 207  # within the rate: taken as it is, rounded towards zero
    assert gate(TORQUE, torque=-8.3, produced=-8.0).torque_wire == -207


def test_torque_is_clipped_at_the_limit_even_where_more_is_produced():
    assert gate(TORQUE, torque=100.0, produced=40.0).torque_wire == 750
    assert gate(TORQUE, torque=-100.0, produced=-40.0).torque_wire == -750
    assert start_from(LIMITS, 99.0, 0.0).torque_wire == 750


def test_target_position_moves_at_the_velocity_limit():
    passed = gate(POSITION, position=1.0)
    assert passed.position == pytest.approx(0.504)
    again = gate(POSITION, position=1.0, held=passed, measured=0.4)  # from the target, not from where the joint lags
    assert again.position == pytest.approx(0.508)
    assert gate(POSITION, position=0.5001, held=passed).position == 0.5001


def test_the_window_ends_the_way_and_rounding_stays_inside():
    near = start_from(LIMITS, 0.0, 1.999)
    passed = gate(POSITION, position=9.0, held=near, measured=1.999)
    assert passed.position == 2.0
    assert passed.position_wire == math.floor(2.0 / LIMITS.position_unit)
    low = gate(POSITION, position=-9.0, measured=-1.999)
    assert low.position_wire == math.ceil(-2.0 / LIMITS.position_unit)


def test_a_joint_outside_the_window_is_led_back_at_the_velocity_limit():
    passed = gate(POSITION, position=2.5, measured=2.1)
    assert passed.position == pytest.approx(2.096)
    passed = gate(POSITION, position=2.5, measured=-2.1)
    assert passed.position == pytest.approx(-2.096)


def test_the_idle_target_follows_what_is():
    assert gate(POSITION, position=0.5, produced=5.0).torque == 5.0
    assert gate(TORQUE, torque=1.0, measured=0.7).position == 0.7
    assert gate(OFF, measured=0.7)[:3] == (0.0, 0.7, 0)


def test_a_lost_reading_keeps_what_was_sent():
    held = gate(POSITION, position=0.502)
    assert gate(POSITION, position=0.502, held=held, produced=math.nan, measured=math.nan)[:2] == (8.0, 0.502)
    held = gate(TORQUE, torque=8.0)
    assert gate(TORQUE, torque=8.0, held=held, produced=math.nan, measured=math.nan)[:2] == (8.0, 0.5)
    assert gate(OFF, measured=math.nan).position == 0.5


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_only_the_field_that_the_mode_needs_must_be_finite(bad):
    assert gate(TORQUE, torque=bad).refused
    assert gate(POSITION, position=bad).refused
    assert not gate(TORQUE, torque=1.0, position=bad).refused
    assert not gate(POSITION, torque=bad).refused
    assert not gate(OFF, torque=bad, position=bad).refused


def test_a_refused_command_moves_nothing():
    held = gate(TORQUE, torque=8.0)
    passed = gate(TORQUE, torque=20.0, held=held, fresh=False)
    assert passed.refused
    assert passed.torque == 8.0
    held = gate(POSITION, position=0.502)
    assert gate(POSITION, position=1.0, held=held, fresh=False).position == 0.502
    assert gate(7).refused
    assert not gate(OFF).refused


def test_freshness():
    assert is_fresh(0.0, 0.1)
    assert is_fresh(0.1, 0.1)
    assert not is_fresh(0.1000001, 0.1)
    assert not is_fresh(-1e-9, 0.1)
    assert not is_fresh(math.nan, 0.1)
    assert not is_fresh(math.inf, 0.1)
