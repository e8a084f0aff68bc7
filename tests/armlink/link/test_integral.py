"""The host's integral term with a drive that has none: it takes over a load, and drives no swing."""

import math

import pytest

from armlink.link.gate import JointLimits, Seen
from armlink.link.integral import Integral

POSITION, PERIOD, STEPS = 8, 0.004, 8


def settles(inertia, kp, kd, load, swing, seconds):
    """Largest distance [rad] from target 0 in the last second, of a joint that a PD drive and the host hold."""
    limits = JointLimits(50.0, 1.0, 0.01, -3.0, 3.0, 10.0, 10.0, 3.0, 0.1, 0.1, PERIOD, kp, kd)
    integral, q, v, far = Integral(), swing, 0.0, 0.0
    ahead = load
    for k in range(round(seconds / PERIOD)):
        seen = Seen(ahead - kp * q - kd * v, q, v, 0.0, True)
        ahead = integral.update(limits, POSITION, 0.0, 0.0, seen)
        for _ in range(STEPS):
            v += PERIOD / STEPS * (ahead - kp * q - kd * v - load) / inertia
            q += PERIOD / STEPS * v
        if k * PERIOD > seconds - 1.0:
            far = max(far, abs(q))
    return far


@pytest.mark.parametrize("inertia", [0.13, 0.17, 0.25])
@pytest.mark.parametrize("load", [0.0, 1.0])
def test_a_swing_that_the_drive_damps_little_dies_out(inertia, load):
    """With a steady rate of 5 /s the loop would be unstable: kd (kp + 5 kd) < 5 kp J."""
    assert 5 * 10.0 * inertia > 0.5 * (10.0 + 5 * 0.5)
    assert settles(inertia, 10.0, 0.5, load, 0.02, 8.0) < 1e-3


def test_a_load_is_taken_over_within_two_seconds():
    assert settles(0.02, 40.0, 2.0, 0.0, 0.0, 2.0) == 0.0
    limits = JointLimits(50.0, 1.0, 0.01, -3.0, 3.0, 10.0, 10.0, 3.0, 0.1, 0.1, PERIOD, 40.0, 2.0)
    integral, ahead, sag = Integral(), 0.0, 0.0
    integral.update(limits, POSITION, 0.0, 0.0, Seen(0.0, 0.0, 0.0, 0.0, True))
    for _ in range(round(2.0 / PERIOD)):  # a load of 4 N·m, quasi-static
        sag = (4.0 - ahead) / 40.0
        ahead = integral.update(limits, POSITION, 0.0, 0.0, Seen(ahead + 40.0 * sag, -sag, 0.0, 0.0, True))
    assert ahead == pytest.approx(4.0, abs=0.05)
    assert math.isfinite(ahead)


@pytest.mark.parametrize("side", [-1, 1])
def test_errors_within_the_deadband_are_left_to_stiction(side):
    limits = JointLimits(50.0, 1.0, 0.01, -3.0, 3.0, 10.0, 10.0, 3.0, 0.1, 0.1, PERIOD, 40.0, 2.0)
    integral = Integral()
    for _ in range(50):
        assert integral.update(limits, POSITION, 0.0, 0.0, Seen(1.0, -side * 4.9e-4, 0.0, 0.0, True)) == 1.0
    assert side * (integral.update(limits, POSITION, 0.0, 0.0, Seen(1.0, -side * 5.1e-4, 0.0, 0.0, True)) - 1.0) > 0.0
