"""The gate: whatever comes, no order exceeds a limit, and what is not known is refused."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.drives.orders import Order, Power
from armlink.link import gate as g
from armlink.link.gate import OFF, JointLimits, Seen, describe_excess, is_fresh, pass_gate, start_order

POSITION, TORQUE, PROFILE_POSITION, PROFILE_TORQUE = 8, 10, 1, 4
anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
modes = st.sampled_from([OFF, POSITION, TORQUE, PROFILE_POSITION, PROFILE_TORQUE, 9, -1])
ages = st.one_of(st.sampled_from([0.0, 0.05, 0.1, 0.1001, -1e-9, math.nan, math.inf]), st.floats(-1, 1))


@st.composite
def limits(draw):
    rated = draw(st.floats(0.5, 500))
    lower = draw(st.floats(-7, 6.9))
    return JointLimits(
        max_torque=rated * draw(st.floats(0.01, 3)),
        torque_step=draw(st.floats(1e-4, 10)),
        position_step=draw(st.floats(1e-6, 0.1)),
        lower=lower,
        upper=lower + draw(st.floats(0.01, 7)),
        overspeed=draw(st.floats(0.01, 10)),
        servo_overspeed=draw(st.floats(0.01, 30)),
        following=draw(st.floats(0.01, 20)),
        outside=draw(st.floats(0.0, 1.0)),
        max_age=0.1,
    )


readings = st.one_of(st.just(math.nan), st.floats(-20, 20), anything)
seen = st.builds(Seen, readings, st.one_of(st.just(math.nan), st.floats(-20, 20)), readings, ages, st.booleans())
cycles = st.lists(st.tuples(modes, anything, anything, ages, seen), min_size=1, max_size=20)


def may_pass(limits, mode, torque, position, age, held, now):
    """The rules once more, as the documentation has them."""
    wanted = {OFF: 0.0, POSITION: position, PROFILE_POSITION: position, TORQUE: torque, PROFILE_TORQUE: torque}
    if mode not in wanted or not math.isfinite(wanted[mode]) or not 0 <= age <= limits.max_age:
        return False
    if not 0 <= now.age <= limits.max_age or math.isnan(now.position) or not now.healthy:
        return False
    if mode in (TORQUE, PROFILE_TORQUE):
        inside = limits.lower - limits.outside <= now.position <= limits.upper + limits.outside
        entered = held.mode in (TORQUE, PROFILE_TORQUE) or math.isfinite(now.torque)
        return inside and entered and -limits.overspeed <= now.velocity <= limits.overspeed
    if mode in (POSITION, PROFILE_POSITION):
        follows = held.mode not in (POSITION, PROFILE_POSITION) or (
            -limits.following <= held.position - now.position <= limits.following
        )
        return follows and (math.isnan(now.velocity) or abs(now.velocity) <= limits.servo_overspeed)
    return True


@settings(max_examples=400, deadline=None)
@given(limits(), st.floats(-20, 20), st.floats(-20, 20), cycles)
def test_no_frame_exceeds_a_limit_whoever_calls(limits, torque, position, cycles):
    held = start_order(limits, torque, position)
    for mode, wanted_torque, wanted_position, age, now in cycles:
        passed = pass_gate(limits, mode, wanted_torque, wanted_position, age, held, now)
        assert bool(passed.refused) != may_pass(limits, mode, wanted_torque, wanted_position, age, held, now)
        assert abs(passed.torque) <= limits.max_torque
        if passed.mode in (TORQUE, PROFILE_TORQUE) and held.mode in (TORQUE, PROFILE_TORQUE):
            assert abs(passed.torque - held.torque) <= limits.torque_step * (1 + 1e-9)
        elif passed.mode in (TORQUE, PROFILE_TORQUE):
            produced = max(-limits.max_torque, min(limits.max_torque, now.torque))
            assert abs(passed.torque - produced) <= limits.torque_step * (1 + 1e-9)
        if passed.mode in (POSITION, PROFILE_POSITION):
            start = held.position if held.mode in (POSITION, PROFILE_POSITION) else now.position
            slack = 1e-12 * (1 + abs(start))
            assert abs(passed.position - start) <= limits.position_step + slack
            assert min(limits.lower, start) - slack <= passed.position <= max(limits.upper, start) + slack
        assert not describe_excess(limits, passed, passed, now)
        assert passed.mode == (0 if passed.refused else mode)
        stands = {True: Power.STOPPED, False: Power.ON if mode else Power.OFF}
        assert passed.power is stands[bool(passed.refused)]
        held = passed


LIMITS = JointLimits(30.0, 0.8, 0.004, -2.0, 2.0, 1.5, 3.0, 0.5, 0.1, 0.1)
START = start_order(LIMITS, 8.0, 0.5)


def gate(
    mode,
    torque=0.0,
    position=0.0,
    held=START,
    produced=8.0,
    measured=0.5,
    velocity=0.0,
    command_age=0.0,
    age=0.0,
    healthy=True,
    limits=LIMITS,
):
    now = Seen(produced, measured, velocity, age, healthy)
    return pass_gate(limits, mode, torque, position, command_age, held, now)


def targets(order):
    return order.torque, order.position


TORQUE_MODES = pytest.mark.parametrize("mode", [TORQUE, PROFILE_TORQUE])
POSITION_MODES = pytest.mark.parametrize("mode", [POSITION, PROFILE_POSITION])


@TORQUE_MODES
def test_the_first_torque_frame_is_one_step_from_the_torque_now_produced(mode):
    passed = gate(mode, torque=-30.0)
    assert passed.torque == pytest.approx(7.2)
    assert gate(mode, torque=30.0).torque == pytest.approx(8.8)
    assert gate(mode, torque=8.3).torque == 8.3  # within the rate: taken as it is
    assert gate(mode, torque=-8.3, produced=-8.0).torque == -8.3
    again = gate(mode, torque=-30.0, held=passed, produced=25.0)  # from what was sent, not from what lags
    assert again.torque == pytest.approx(6.4)
    assert gate(mode, torque=-30.0, held=gate(POSITION, position=0.5), produced=5.0).torque == pytest.approx(4.2)


def test_torque_is_clipped_at_the_limit_even_where_more_is_produced():
    assert gate(TORQUE, torque=100.0, produced=40.0).torque == 30.0
    assert gate(TORQUE, torque=-100.0, produced=-40.0).torque == -30.0
    assert start_order(LIMITS, 99.0, 0.0).torque == 30.0


@POSITION_MODES
def test_target_position_moves_at_the_velocity_limit(mode):
    passed = gate(mode, position=1.0)
    assert passed.position == pytest.approx(0.504)
    again = gate(mode, position=1.0, held=passed, measured=0.4)  # from the target, not from where the joint lags
    assert again.position == pytest.approx(0.508)
    assert gate(mode, position=0.5001, held=passed).position == 0.5001
    assert gate(mode, position=-1.0, held=passed).position == pytest.approx(0.5)


@POSITION_MODES
def test_the_window_ends_the_way(mode):
    near = start_order(LIMITS, 0.0, 1.999)
    assert gate(mode, position=9.0, held=near, measured=1.999).position == 2.0
    assert gate(mode, position=-9.0, measured=-1.999).position == -2.0


def test_a_joint_outside_the_window_is_led_back_at_the_velocity_limit():
    passed = gate(POSITION, position=2.5, measured=2.1)
    assert passed.position == pytest.approx(2.096)
    passed = gate(POSITION, position=2.5, measured=-2.1)
    assert passed.position == pytest.approx(-2.096)


def test_the_idle_target_follows_what_is():
    assert gate(POSITION, position=0.5, produced=5.0).torque == 5.0
    assert gate(TORQUE, torque=1.0, measured=0.7).position == 0.7
    assert targets(gate(OFF, measured=0.7)) == (0.0, 0.7)
    held = gate(TORQUE, torque=8.0)
    assert gate(POSITION, position=0.5, held=held, produced=5.0).torque == 5.0
    assert gate(POSITION, position=0.5, held=held, measured=0.7).position == pytest.approx(0.696)
    assert gate(OFF, held=gate(POSITION, position=0.502), measured=0.7).position == 0.502


def test_a_lost_torque_keeps_what_was_sent():
    held = gate(POSITION, position=0.502)
    assert gate(POSITION, position=0.502, held=held, produced=math.nan).torque == 8.0
    held = gate(TORQUE, torque=8.0)
    assert targets(gate(TORQUE, torque=8.0, held=held, produced=math.nan)) == (8.0, 0.5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_only_the_field_that_the_mode_needs_must_be_finite(bad):
    for mode in (TORQUE, PROFILE_TORQUE):
        assert gate(mode, torque=bad).refused == g.BAD_NUMBER
        assert not gate(mode, torque=1.0, position=bad).refused
    for mode in (POSITION, PROFILE_POSITION):
        assert gate(mode, position=bad).refused == g.BAD_NUMBER
        assert not gate(mode, torque=bad).refused
    assert not gate(OFF, torque=bad, position=bad).refused


@pytest.mark.parametrize("mode", [OFF, POSITION, TORQUE, PROFILE_POSITION, PROFILE_TORQUE])
def test_what_no_command_passes_with(mode):
    assert gate(mode).refused == ""
    assert gate(mode, command_age=0.11).refused == g.COMMAND_AGE
    assert gate(mode, command_age=-1e-6).refused == g.COMMAND_AGE
    assert gate(mode, age=0.11).refused == g.SAMPLE_AGE
    assert gate(mode, age=-1e-6).refused == g.SAMPLE_AGE
    assert gate(mode, measured=math.nan).refused == g.SAMPLE_AGE
    assert gate(mode, healthy=False).refused == g.STATE
    assert gate(mode, command_age=0.1, age=0.1).refused == ""


@pytest.mark.parametrize("mode", [2, 3, 6, 7, 9, -1, 128])
def test_other_modes_are_refused(mode):
    assert gate(mode).refused == g.BAD_MODE


@TORQUE_MODES
def test_nothing_but_the_gate_bounds_a_joint_under_torque_control(mode):
    for velocity in (1.5, -1.5):
        assert not gate(mode, velocity=velocity).refused
        assert gate(mode, velocity=velocity * 1.001).refused == g.VELOCITY
    assert gate(mode, velocity=math.nan).refused == g.VELOCITY
    for measured in (2.1, -2.1):
        assert not gate(mode, measured=measured).refused
        assert gate(mode, measured=measured * 1.001).refused == g.WINDOW
    assert gate(mode, produced=math.nan).refused == g.ENTRY
    assert gate(mode, produced=math.inf).refused == g.ENTRY


@POSITION_MODES
def test_a_joint_under_position_control_must_follow_its_target_at_a_bounded_speed(mode):
    for velocity in (3.0, -3.0):
        assert not gate(mode, velocity=velocity, measured=3.0, produced=math.nan).refused
        assert gate(mode, velocity=velocity * 1.001).refused == g.VELOCITY
    assert not gate(mode, velocity=math.nan).refused
    held = gate(mode, position=0.5)
    for measured in (0.0, 1.0):
        assert not gate(mode, position=0.5, held=held, measured=measured).refused
        assert gate(mode, position=0.5, held=held, measured=measured + (measured - 0.5) * 0.01).refused == g.FOLLOWING
    assert not gate(mode, position=0.5, held=gate(TORQUE, torque=8.0), measured=1.5).refused  # starts where it is
    assert not gate(TORQUE, torque=8.0, held=held, measured=1.5).refused
    assert not gate(OFF, held=held, measured=1.5, velocity=9.0).refused


def test_a_refused_command_moves_nothing():
    held = gate(TORQUE, torque=8.0)
    passed = gate(TORQUE, torque=20.0, held=held, healthy=False, produced=3.0, measured=0.6)
    assert targets(passed) == (8.0, 0.6)
    assert passed.mode == OFF
    held = gate(POSITION, position=0.502)
    assert targets(gate(POSITION, position=1.0, held=held, healthy=False, produced=3.0)) == (3.0, 0.502)
    held = gate(POSITION, position=0.502)
    assert targets(gate(POSITION, position=1.0, held=held, age=1.0, produced=math.nan, measured=math.nan)) == (
        8.0,
        0.502,
    )


def test_what_the_first_cycle_starts_from():
    assert Order(Power.OFF, False, OFF, 0.5, 0.0, 8.0, 0.0, 0.0) == START
    assert start_order(LIMITS, math.nan, 0.5).torque == 0.0
    assert start_order(LIMITS, math.inf, 0.5).torque == 0.0


def test_freshness():
    assert is_fresh(0.0, 0.1)
    assert is_fresh(0.1, 0.1)
    assert not is_fresh(0.1000001, 0.1)
    assert not is_fresh(-1e-9, 0.1)
    assert not is_fresh(math.nan, 0.1)
    assert not is_fresh(math.inf, 0.1)
