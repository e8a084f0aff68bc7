"""The gate where a drive has gains: all that they come to is on a leash, and so is what the bytes say at last."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.drives.orders import Order, Power
from armlink.link.gate import (
    OFF,
    TORQUE_LIMIT_SHARE,
    JointLimits,
    Seen,
    describe_excess,
    hold_order,
    pass_gate,
    start_order,
)

POSITION, TORQUE = 8, 10
LIMITS = JointLimits(30.0, 0.8, 0.004, -2.0, 2.0, 1.5, 3.0, 0.5, 0.1, 0.1)
MOST = 30.0 * TORQUE_LIMIT_SHARE
AT = Seen(0.0, 0.5, 0.0, 0.0, True)
GAINS = replace(LIMITS, period=0.004, kp=40.0, kd=1.5)


def gate(mode, torque, position, held, now=AT, limits=GAINS):
    return pass_gate(limits, mode, torque, position, 0.0, held, now)


def held_at(position, limits=GAINS):
    return start_order(limits, 0.0, position)._replace(mode=POSITION)


def pull(order, measured=0.5, velocity=0.0):
    """What a drive with gains makes of an order, as its joint is now."""
    return order.kp * (order.position - measured) + order.kd * (order.velocity - velocity) + order.torque


@settings(max_examples=400, deadline=None)
@given(
    st.floats(-500, 500), st.floats(-20, 20), st.floats(-2.5, 2.5), st.floats(-3, 3), st.floats(-3, 3), st.booleans()
)
def test_gains_targets_and_feed_forward_together_are_on_a_leash(torque, position, start, measured, velocity, known):
    now = Seen(0.0, measured, velocity if known else math.nan, 0.0, True)
    held = held_at(start)
    passed = pass_gate(GAINS, POSITION, torque, position, 0.0, held, now)
    if passed.refused:
        return
    assert abs(pull(passed, measured, velocity if known else 0.0)) <= 30.0 * (1 + 1e-9)
    assert 0 <= passed.kp <= 40.0
    assert 0 <= passed.kd <= 1.5
    assert abs(passed.velocity) <= 0.004 / 0.004 * (1 + 1e-9)
    assert not describe_excess(GAINS, passed, passed, now)


def test_a_drive_with_gains_gets_rate_and_feed_forward():
    held = held_at(0.5)
    passed = gate(POSITION, 7.0, 0.502, held)
    assert (passed.position, passed.torque, passed.kp, passed.kd) == (0.502, 7.0, 40.0, 1.5)
    assert passed.velocity == pytest.approx(0.002 / 0.004)
    assert gate(TORQUE, 8.1, 0.0, start_order(GAINS, 8.0, 0.5), Seen(8.0, 0.5, 0.0, 0.0, True))[5:8] == (8.1, 0.0, 0.0)
    assert pull(hold_order(GAINS, 29.0, 0.6, Seen(0.0, 0.5, 0.0, 0.0, True))) == pytest.approx(0.97 * 30.0)


@pytest.mark.parametrize(
    "changed",
    [
        {"position": 2.01},
        {"position": -2.01},
        {"torque": 30.1},
        {"torque": -31.1},
        {"kp": 400.0, "position": 0.6},
        {"kd": 60.0, "velocity": 0.6},
    ],
)
def test_bytes_that_say_something_else_do_not_leave(changed):
    now = Seen(0.0, 0.5, 0.0, 0.0, True)
    passed = gate(POSITION, 0.0, 0.502, held_at(0.5))
    assert not describe_excess(GAINS, passed, passed, now)
    assert describe_excess(GAINS, passed, passed._replace(**changed), now)
    assert not describe_excess(GAINS, passed, passed._replace(power=Power.OFF, **changed), now)
    torque = pass_gate(LIMITS, TORQUE, 8.1, 0.0, 0.0, start_order(LIMITS, 8.0, 0.5), now._replace(torque=8.0))
    assert not describe_excess(LIMITS, torque, torque, now)
    assert describe_excess(LIMITS, torque, torque._replace(torque=30.1), now)


def test_without_gains_a_period_or_a_calibration_nothing_is_made_up():
    bare = JointLimits(0.5, 0.8, 0.004, -2.0, 2.0, 1.5, 3.0, 0.5, 0.1, 0.1)
    assert (bare.period, bare.kp, bare.kd, bare.most_sent) == (0.0, 0.0, 0.0, 0.5)
    passed = gate(POSITION, 0.0, 0.502, held_at(0.5), limits=replace(bare, kp=40.0))
    assert (passed.velocity, passed.kd) == (0.0, 0.0)


def test_a_target_on_the_leash_stretches_no_further_and_has_no_rate():
    far = replace(GAINS, following=5.0)
    passed = gate(POSITION, 0.0, 1.6, held_at(1.5, far), limits=far)
    assert passed.position == 0.5 + MOST / 40.0
    assert passed.velocity == 0.0
    assert gate(POSITION, 0.0, -1.6, held_at(-1.5, far), limits=far).position == 0.5 - MOST / 40.0


@pytest.mark.parametrize("velocity", [100.0, -100.0])
def test_a_joint_that_is_thrown_about_is_damped_as_much_as_the_limit_allows(velocity):
    now, sign = AT._replace(velocity=velocity), math.copysign(1.0, velocity)
    passed = hold_order(GAINS, 5.0 * sign, 0.5, now)
    assert (passed.velocity, passed.kd) == (0.0, pytest.approx(MOST / 100.0))
    assert passed.torque == pytest.approx(5.0 * sign)
    assert pull(passed, velocity=velocity) == pytest.approx((5.0 - MOST) * sign)
    more = hold_order(GAINS, -5.0 * sign, 0.5, now)  # as much as it may be is spent on damping
    assert more.torque == pytest.approx(0.0, abs=1e-9)


def test_a_rate_that_would_cost_too_much_is_left_out():
    stiff, slow = replace(GAINS, kd=60.0), replace(GAINS, kd=20.0)
    passed = gate(POSITION, 29.0, 0.504, held_at(0.5), AT._replace(velocity=math.nan, position=0.504), stiff)
    assert (passed.velocity, passed.torque, passed.kd) == (0.0, 29.0, 60.0)
    passed = gate(POSITION, 0.0, 0.504, held_at(0.5), AT._replace(velocity=-1.0), slow)
    assert (passed.velocity, passed.kd) == (0.0, 20.0)  # within the limit by itself


def test_damping_of_just_the_limit_is_within_it():
    wide = replace(GAINS, position_step=0.25, period=0.25, kp=1.0, kd=MOST)
    passed = gate(POSITION, 0.0, 1.0, held_at(0.5), limits=wide)
    assert (passed.position, passed.velocity, passed.kd) == (0.75, 1.0, MOST)


def test_a_hold_without_gains_or_a_reading_says_position_and_torque():
    assert hold_order(LIMITS, 5.0, 0.6, AT) == Order(Power.ON, False, POSITION, 0.6, 0.0, 5.0, 0.0, 0.0)
    for unknown, torque in ((math.nan, 0.0), (math.inf, 0.0), (5.0, 5.0)):
        held = hold_order(GAINS, unknown, 0.6, AT._replace(position=math.nan))
        assert held == Order(Power.ON, False, POSITION, 0.6, 0.0, torque, 0.0, 0.0)


def order(position=0.5, torque=0.0, kp=0.0, kd=0.0, velocity=0.0, mode=POSITION):
    return Order(Power.ON, False, mode, position, velocity, torque, kp, kd)


def test_the_last_check_of_a_torque_knows_single_precision_and_no_more():
    for mode, kp in ((TORQUE, 0.0), (POSITION, 0.0), (POSITION, 40.0)):
        for sign in (1, -1):
            just, over = (order(torque=30.0 * sign * (1 + part), mode=mode, kp=kp) for part in (1e-6, 2e-6))
            assert describe_excess(GAINS, just, just, AT) == ""
            assert "30.0001 N·m" in describe_excess(GAINS, over, over, AT)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_last_check_of_a_position_knows_the_window_and_the_way_back(sign):
    def ends(goal, position):
        return not describe_excess(LIMITS, order(goal * sign), order(position * sign), AT)

    for goal in (0.5, 2.0, -2.0):
        assert [ends(goal, at) for at in (0.4, 0.6, 2.000002, -2.000002)] == [True] * 4
        assert [ends(goal, at) for at in (2.000004, 2.0005, -2.0005, 9.0)] == [False] * 4
    assert [ends(2.1, at) for at in (0.4, 2.1, 2.1005, -2.0005)] == [True] * 4  # as it is led back
    assert [ends(2.1, at) for at in (2.102, -2.002, -2.1)] == [False] * 3


@pytest.mark.parametrize("window", [(-1.0, -1e-6), (1e-6, 1.0)])
def test_the_last_check_takes_the_bound_itself(window):
    lower, upper = window
    narrow = replace(LIMITS, lower=lower, upper=upper)
    assert describe_excess(narrow, order((lower + upper) / 2), order(0.0), AT) == ""


def test_the_last_check_takes_gains_one_by_one():
    assert describe_excess(GAINS, order(), order(position=1.5, kp=40.0), AT) == "40 N·m (by its gains and targets)"
    assert describe_excess(GAINS, order(), order(velocity=1.0, kd=40.0), AT) == "40 N·m (by its gains and targets)"
    blind = AT._replace(position=math.nan)
    assert describe_excess(GAINS, order(), order(kp=1.0), blind)
    assert describe_excess(GAINS, order(), order(), blind) == ""  # without gains the drive needs no reading of ours
    assert describe_excess(GAINS, order(), order(position=99.0, torque=99.0, mode=OFF), AT) == ""
