"""What readings prove about the motion of a joint, and what they do not: nothing is put down to a drive that a late
host, a late reply or a lost frame explains."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlink.link.bus_watchdog import (
    CROWD_FRAMES,
    CROWD_PER_JOINT,
    CROWDED_CYCLES,
    EXCESS_READINGS,
    SLOW_CYCLES,
    BusWatch,
)
from armlink.link.motion_watchdog import MotionWatch

PERIOD, MOST = 0.004, 1.0
STEP = 2 * np.pi / 2**12
"""Of a coarse encoder [rad]."""


def watch(step=STEP):
    made = MotionWatch(1, PERIOD)
    made.use(np.array([step]), np.array([MOST]))
    return made


@st.composite
def motions(draw):
    """A smooth motion of at most MOST; times in which samples may have been taken, which wander and jump with the host;
    delay of the velocity; whether a reading is lost."""
    seed = draw(st.integers(0, 2**32 - 1))
    return np.random.default_rng(seed), draw(st.floats(0.0, 0.01)), draw(st.sampled_from([0.0, 0.1, 0.5]))


@settings(max_examples=60, deadline=None)
@given(motions())
def test_a_sound_joint_is_neither_contradicted_nor_proven_fast(motion):
    random, delay, lost = motion
    made, now = watch(), 0.0
    amplitude, omega = random.uniform(0.0, 1.0), random.uniform(0.5, 6.0)
    amplitude = min(amplitude, MOST / omega)

    def angle(t):
        return amplitude * np.sin(omega * t)

    velocity, came = np.nan, -np.inf
    for cycle in range(400):
        asked = now
        answered = asked + random.uniform(0.0, 0.9 * PERIOD) + (random.random() < 0.02) * random.uniform(0.0, 0.3)
        taken = random.uniform(asked, answered)
        if cycle % SLOW_CYCLES == 0:
            came = answered
            velocity = amplitude * omega * np.cos(omega * (taken - delay)) + random.uniform(-0.02, 0.02)
        if random.random() >= lost:
            reading = STEP * np.rint(angle(taken) / STEP)
            made.update([reading], [asked], [answered], [velocity], [came])
            assert not made.contradicted[0]
            assert made.proven[0] <= amplitude * omega * (1 + 1e-9)
        now = max(answered, asked + PERIOD)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5))
def test_no_joint_is_ahead_of_its_own_acceleration_however_unevenly_its_readings_come(seed, late):
    random = np.random.default_rng(seed)
    made, now, lead = watch(2 * np.pi / 2**16), 0.0, 3 * PERIOD
    speed, acceleration = random.uniform(-1.0, 1.0), random.uniform(-5.0, 5.0)
    step, turned = 2 * np.pi / 2**16, []
    for _ in range(100):
        turned.append(abs(speed + acceleration * now))
        reading = step * np.rint((speed * now + acceleration * now**2 / 2) / step)
        made.update([reading], [now], [now], [turned[-1]], [now])
        assert made.ahead[0] <= max(*turned[-9:], abs(speed + acceleration * (now + lead))) + 1e-6
        now += random.uniform(0.0, 0.1) * PERIOD if random.random() < late else random.uniform(0.5, 3.0) * PERIOD


def test_a_steady_speed_is_proven_by_positions_alone():
    made = watch(2 * np.pi / 2**17)
    for cycle in range(40):
        now = cycle * PERIOD
        made.update([2.0 * now], [now], [now], [np.nan], [now])
    assert made.proven[0] == pytest.approx(2.0, rel=0.01)
    assert made.ahead[0] == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("told", [0.0, 0.2, 5.0])
def test_a_velocity_that_the_positions_do_not_bear_out_contradicts_them(told):
    made, noticed = watch(2 * np.pi / 2**17), 0.0
    for cycle in range(400):
        now = cycle * PERIOD
        speed = 2.0 * now
        made.update([now**2], [now], [now], [told * speed], [now])
        if made.contradicted[0]:
            noticed = speed
            break
    assert 0.0 < noticed < 1.0


def test_scales_that_the_scale_check_looks_for_are_left_to_it():
    for factor in (1 / 1.4, 1.4):
        made = watch()
        for cycle in range(500):
            now = cycle * PERIOD
            made.update([0.5 * now], [now], [now], [factor * 0.5], [now])
            assert not made.contradicted[0]


def test_after_an_interruption_nothing_is_proven():
    made = watch()
    for cycle in range(20):
        made.update([0.0], [cycle * PERIOD], [cycle * PERIOD], [0.0], [cycle * PERIOD])
    made.restart()
    made.update([3.0], [0.1], [0.1], [0.0], [0.1])
    assert not made.contradicted[0]
    assert made.proven[0] == 0.0


def test_velocities_that_come_as_often_as_a_drive_sends_them_are_one_senders():
    bus = BusWatch(2)
    for cycle in range(1000):
        bus.syncs += 1
        if cycle % SLOW_CYCLES == 3:
            bus.slow(0)
        if cycle % SLOW_CYCLES == 0 and cycle % 24:  # some are lost
            bus.slow(1)
    assert bus.forged is None
    for _ in range(EXCESS_READINGS + 1):  # one may be early
        bus.slow(0)
    assert bus.forged == 0


def test_torques_that_come_apart_from_positions_are_one_senders_while_they_come_as_often():
    bus = BusWatch(1)
    random = np.random.default_rng(5)
    for _ in range(20_000):
        bus.readings[0] += random.random() > 0.002  # some are lost
        if random.random() > 0.01:
            bus.torque_alone(0)
    assert bus.forged is None
    for _ in range(EXCESS_READINGS + 1):
        bus.readings[0] += 1
        bus.torque_alone(0)
        bus.torque_alone(0)
    assert bus.forged == 0


def test_a_joint_that_strikes_its_stop_and_turns_round_is_not_contradicted() -> None:
    """Its velocity is that after the stroke, its positions still tell of the way before it."""
    watch = MotionWatch(1, PERIOD)
    watch.use(np.array([1e-4]), np.array([1.0]))
    position, velocity = 0.0, -0.9
    for cycle in range(60):
        if cycle == 30:
            velocity = 1.45  # between two samples, the newest of which is just after it
        else:
            position += velocity * PERIOD
        t = cycle * PERIOD
        watch.update([position], [t], [t], [velocity], [t])
        assert not watch.contradicted[0]


@pytest.mark.parametrize(("rate", "contradicted"), [(250.0, True), (50.0, False)])
def test_a_joint_that_swings_in_time_with_slow_cycles_is_not_contradicted(rate: float, contradicted: bool) -> None:
    """Each velocity meets the same phase of the swing, which is that of a drive between two targets; at 250 Hz a drive
    cannot swing so fast."""
    watch, found = MotionWatch(1, 1 / rate), False
    watch.use(np.array([1e-4]), np.array([1.0]))
    for cycle in range(round(4 * rate)):
        t = cycle / rate
        watch.update([0.01 * t], [t], [t], [-0.13], [t])
        found = found or watch.contradicted[0]
    assert found == contradicted


@pytest.mark.parametrize("rate", [250.0, 50.0])
@pytest.mark.parametrize("factor", [0.0, -1.0])
def test_a_velocity_that_is_stuck_or_reversed_is_contradicted_at_any_rate(rate: float, factor: float) -> None:
    watch, noticed = MotionWatch(1, 1 / rate), math.inf
    watch.use(np.array([1e-4]), np.array([1.0]))
    for cycle in range(round(2 * rate)):
        t = cycle / rate
        speed = min(t, 0.8)
        watch.update([t**2 / 2 if t < 0.8 else 0.8 * t - 0.32], [t], [t], [factor * speed], [t])
        if watch.contradicted[0]:
            noticed = t
            break
    assert noticed < 1.0


@pytest.mark.parametrize("rate", [250.0, 50.0])
def test_a_sound_joint_that_swings_is_not_contradicted(rate: float) -> None:
    """A swing of its own beside the one in time with the cycles, whose phase the velocity meets at 50 Hz."""
    watch, ripple = MotionWatch(1, 1 / rate), 0.1 if rate < 100 else 0.0
    watch.use(np.array([1e-4]), np.array([1.0]))
    for cycle in range(round(6 * rate)):
        t = cycle / rate
        velocity = 0.8 * np.cos(2.0 * t) + ripple * np.cos(2 * np.pi * 50.0 * t)
        watch.update([0.4 * np.sin(2.0 * t)], [t], [t], [velocity], [t])
        assert not watch.contradicted[0]


def test_a_late_host_gets_the_frames_of_the_time_that_it_took() -> None:
    """The limit of frames is one of time: what a drive sends by its own clock comes whether the host is late or not."""
    for periods in (1.0, 4.0, 10.0):
        bus = BusWatch(1)
        most = round(periods * (CROWD_PER_JOINT + CROWD_FRAMES))
        for _ in range(2 * CROWDED_CYCLES):
            bus.cycle_ends(most, periods)
            assert not bus.babbling
        for _ in range(CROWDED_CYCLES):
            assert not bus.babbling
            bus.cycle_ends(2 * most, periods)
        assert bus.babbling


@given(
    cycles=st.lists(st.integers(0, 500), min_size=30, max_size=200),
    extra=st.integers(CROWD_PER_JOINT + CROWD_FRAMES, 20 * CROWD_FRAMES),
)
def test_a_backlog_is_no_flood_however_many_cycles_bring_it(cycles: list[int], extra: int) -> None:
    """What waited while host or device had no processor comes at once or little by little; a flood stays."""
    bus, limit = BusWatch(1), CROWD_PER_JOINT + CROWD_FRAMES
    left = (CROWDED_CYCLES - 1) * limit
    for wanted in cycles:
        more = min(wanted, left)
        left -= more
        bus.cycle_ends(limit + more, 1.0)
        assert not bus.babbling
    for _ in range(CROWDED_CYCLES):
        bus.cycle_ends(limit + extra, 1.0)
    assert bus.babbling


def test_answers_to_other_requests_do_not_make_readings_that_catch_up_a_second_node():
    bus = BusWatch(1)

    def cycle(came: int) -> None:
        bus.syncs += 1
        for number in range(came):
            bus.readings[0] += 1
            if number:
                bus.again(0)
        bus.cycle_ends(came, 1.0)

    for came in [1, 2, 1, 1, 2, 1, 1, 2, 1]:  # three requests beside the cycle are answered
        cycle(came)
    for came in [0, 0, 0, 0, 2, 2, 2, 2, 1]:  # the host is late by four cycles
        cycle(came)
        assert bus.doubled is None
    for _ in range(3):
        cycle(2)
    assert bus.doubled == 0
