"""Single figures of the checks before a diagnosis: sample times, correlations, delays, signs, units."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armlink.recording.corrections import Corrections
from sim_gap.checks import hypotheses
from sim_gap.checks.joint_range import _degrees
from sim_gap.checks.rigid_fit import ChannelMotion, RigidFit, _partial, fit_models
from sim_gap.checks.sampling import _sample_times
from sim_gap.checks.torque_delay import REPEATS, SURE, _repeats
from sim_gap.checks.torque_source import find_unsigned

NOTHING_STATED = Corrections()


@pytest.mark.parametrize("missing", [0, 1, 3, 60, 400])
@pytest.mark.parametrize("at", [100, 300, 600])
def test_times_of_receipt_scatter_about_even_ones_whose_gaps_stay(missing: int, at: int) -> None:
    """A hundred rows a second, received within some milliseconds, of which some are missing in a row."""
    number = np.concatenate([np.arange(at), np.arange(at + missing, 700 + missing)])
    stamps = 0.01 * number + 0.002 * np.random.default_rng(1).standard_normal(len(number))
    even = _sample_times(np.sort(stamps))
    assert even is not None
    np.testing.assert_allclose(even, 0.01 * number, atol=1e-3)


def test_every_gap_is_kept() -> None:
    number = np.delete(np.arange(1000), [*range(200, 203), *range(240, 242), *range(500, 560), *range(900, 901)])
    stamps = 0.01 * number + 0.002 * np.random.default_rng(1).standard_normal(len(number))
    even = _sample_times(np.sort(stamps))
    assert even is not None
    np.testing.assert_allclose(even, 0.01 * number, atol=1e-3)


def test_a_clock_that_changes_its_rate_has_no_even_times() -> None:
    number = np.arange(700)
    stamps = np.where(number < 350, 0.01 * number, 3.5 + 0.011 * (number - 350))
    assert _sample_times(stamps + 1e-4 * np.random.default_rng(1).standard_normal(700)) is None


def test_a_partial_correlation_is_that_of_what_the_others_leave() -> None:
    """Of model (first) and reading (last), both about their fit to the three columns between."""
    random = np.random.default_rng(2)
    x = random.normal(size=(500, 6)) @ random.normal(size=(6, 6))
    rest = [x[:, k] - x[:, 1:4] @ np.linalg.lstsq(x[:, 1:4], x[:, k], rcond=None)[0] for k in (0, 5)]
    expected = (rest[0] @ rest[1]) / np.sqrt((rest[0] @ rest[0]) * (rest[1] @ rest[1]))
    correlation, own = _partial((x.T @ x / len(x))[None])
    assert correlation == pytest.approx([expected])
    assert own == pytest.approx([np.sqrt(np.mean(rest[0] ** 2))])


def test_every_motion_has_its_own_fit_and_friction_only_where_it_moves() -> None:
    t = np.linspace(0.0, 20.0, 800)[:, None]
    torque, v = 3.0 * np.sin(0.7 * t), 0.5 * np.cos(1.3 * t)
    turning = ChannelMotion(t, v, -0.6 * np.sin(1.3 * t), 2.0 * torque + 0.4 * np.sign(v), "tau_motor")
    resting = ChannelMotion(t, 0.0 * v, 0.0 * v, 2.0 * torque, "tau_motor")
    moved, still = fit_models([(torque, turning), (torque, resting)])
    assert moved.scale == pytest.approx([2.0], rel=0.02)
    assert moved.friction == pytest.approx([0.4], rel=0.1)
    assert np.isnan(still.friction).all()
    assert isinstance(moved, RigidFit)


@pytest.mark.parametrize(("higher", "repeats"), [(0.9 * REPEATS * SURE, True), (1.1 * REPEATS * SURE, False)])
def test_a_motion_repeats_if_another_delay_costs_half_of_what_is_sure(higher: float, repeats: bool) -> None:
    costs = {0.0: 3.0, 0.4: 1.0, 0.5: 0.0, 0.6: 1.0, 1.2: 1.0, 1.3: higher, 1.4: 1.0}
    assert _repeats(costs, 0.5, SURE) is repeats


@pytest.mark.parametrize(("similar", "named"), [(0.0, True), (0.8, False)])
def test_a_motor_torque_of_one_sign_that_follows_the_model_is_no_amount(similar: float, named: bool) -> None:
    """Something may press on the joint all the time; an amount follows the model's amount, or not at all."""
    t = np.linspace(0.0, 60.0, 3000)[:, None]
    m, other = np.sin(1.1 * t), np.cos(1.7 * t)
    v = 0.5 * np.cos(0.9 * t)
    reading = 10.0 + similar * m + np.sqrt(1.0 - similar**2) * other
    arm = SimpleNamespace(n=1, names=("joint_1",), carried=lambda q, v, a: m)
    found = find_unsigned(arm, ChannelMotion(t, v, v, reading, "tau_motor"), NOTHING_STATED)
    assert [finding.finding for finding in found] == ["unsigned"] * named


def test_degrees_become_radians() -> None:
    turned = np.array([[180.0, -90.0]])
    found = hypotheses._degrees(ChannelMotion(turned, turned, turned, turned, "tau"))
    for x in (found.q, found.v, found.a):
        np.testing.assert_allclose(x, [[np.pi, -0.5 * np.pi]], rtol=1e-12)
    assert found.reading is turned


def test_the_option_for_degrees_names_what_was_recorded() -> None:
    there = np.zeros((1, 1))
    for velocity, command, option in (
        (None, None, "--units q=deg"),
        (there, None, "--units q=deg,dq=deg"),
        (there, there, "--units q=deg,dq=deg,q_cmd=deg"),
    ):
        assert _degrees(SimpleNamespace(velocity=velocity, position_command=command)) == option


def test_what_friction_holds_at_rest_is_no_part_of_a_motors_fit() -> None:
    """It moves for a fifth of the time. A sensor on the link reads the model at rest, too, and a joint that hardly
    moves has nothing else."""
    random = np.random.default_rng(2)
    t = np.arange(0.0, 30.0, 0.02)
    v = np.where(t % 5.0 < 1.0, np.sin(2.0 * np.pi * t), 0.0)[:, None]
    model = random.normal(size=(len(t), 1))
    reading = model + np.where(v == 0.0, np.repeat(random.uniform(-3.0, 3.0, 30), 50)[:, None], 3.0 * np.sign(v))
    moved = ChannelMotion(v, v, 0.0 * v, reading, "tau_motor")
    seldom = np.where(t[:, None] < 5.0, v, 0.0)
    fits = fit_models([(model, moved), (model, replace(moved, channel="tau")), (model, replace(moved, v=seldom))])
    explained = [float(fit.explained[0]) for fit in fits]
    assert explained[0] > 0.98
    assert max(explained[1:]) < 0.7
