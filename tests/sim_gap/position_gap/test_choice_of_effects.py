"""Whether an effect pays in most windows and recordings, and what a choice that is not sure leaves open."""

from dataclasses import replace

import numpy as np
import pytest
from servo_arm import fitted

from sim_gap.position_gap.doubt import Other, _tail, plainest_fit, settle
from sim_gap.position_gap.fit import LoopFit, improve
from sim_gap.position_gap.search import PRICE, LoopSearch, effect_there, with_effect, without_group
from sim_gap.position_gap.training.draws import draw
from sim_gap.position_gap.training.spread import (
    Covariance,
    alternatives,
    covariance,
    interval,
    quantiles,
    undecided_scale,
)


@pytest.fixture(scope="module")
def several() -> tuple[LoopSearch, LoopFit]:
    """Four recordings of an arm with friction, beside a model without."""
    search, fit = fitted(0.2, 0.2, 0.2, 0.2)
    return replace(search, nominal={**search.nominal, "coulomb": np.zeros(2)}), fit


def quiet(_: str) -> None:
    """Progress that nobody reads."""


def test_what_pays_in_every_window_is_there_and_what_pays_in_one_is_in_doubt() -> None:
    windows = np.arange(12)
    everywhere = np.full(12, 5.0) + np.sin(windows)
    assert _tail(everywhere, windows, PRICE) < 1e-6
    once = np.where(windows == 3, 60.0 + everywhere.sum(), -5.0)
    assert once.sum() > everywhere.sum() / 2
    assert _tail(once, windows, PRICE) > 0.2


def test_a_sum_that_does_not_pay_is_likelier_none() -> None:
    assert _tail(np.full(4, 0.5) + 0.1 * np.arange(4), np.arange(4), PRICE) > 0.5


def test_one_recording_says_nothing_of_others() -> None:
    assert _tail(np.arange(8.0), np.zeros(8, int), PRICE) == 0.0


@pytest.mark.long
def test_an_effect_that_the_arm_does_not_have_is_taken_out_and_friction_stays(several) -> None:
    search, fit = several
    more = improve(search.data, with_effect(search, fit, "transmission.spring", 1), search.scales)
    found, others = settle(search, more, quiet)
    assert not effect_there(found, "transmission.spring", 1)
    assert all(effect_there(found, "friction.coulomb", j) for j in (0, 1))
    likely = {each.group: each.likely for each in others}
    assert all(likely["friction.coulomb", (j,)] < 0.01 for j in (0, 1))


@pytest.mark.long
def test_a_payload_that_the_arm_does_not_have_is_compared_with_the_joints_own_effects(several) -> None:
    search, fit = several
    names = ("payload.mass", "payload.x", "payload.z")
    point = {**fit.point, **{name: np.zeros(2) for name in names}}
    heavy = improve(search.data, replace(fit, point=point, shared=names, rms=None), search.scales)
    found, others = settle(search, heavy, quiet)
    assert found.shared == ()
    assert [each.likely < 0.5 for each in others if each.group == ("link.payload", ())] == [True]


def test_the_plainest_choice_has_gain_and_friction_alone_wherever_there_is_more(several) -> None:
    search, fit = several
    assert not [*plainest_fit(search, fit)]
    more = fit.with_values(spring=np.array([0.0, 0.2]), offset=np.array([0.0, 0.3]))
    more = replace(more, active=(("kp",), (*fit.active[1], "spring", "offset")), rms=None)
    (plain,) = plainest_fit(search, more)
    assert plain.active[0] == ("kp",)
    assert {*plain.active[1]} == {"kp", "coulomb", "viscous"}
    assert (plain.point["spring"][1], plain.point["offset"][1]) == (0.0, 0.0)
    np.testing.assert_allclose(plain.rms[1], fit.rms[1], rtol=0.05)
    loaded = replace(fit.with_values(**{"payload.mass": np.full(2, 0.3)}), shared=("payload.mass",), rms=None)
    (plain,) = plainest_fit(search, loaded)
    assert plain.shared == ()
    assert plain.point["payload.mass"][0] == 0.0


def test_the_plainest_choice_has_nothing_that_is_withheld(several) -> None:
    search, fit = several
    more = replace(fit, active=((*fit.active[0], "asymmetry"), fit.active[1]), rms=None)
    (plain,) = plainest_fit(replace(search, excluded=frozenset({"friction.viscous"})), more)
    assert {*plain.active[0]} == {"kp", "coulomb"}
    assert plain.point["viscous"][0] == search.nominal["viscous"][0]


def test_the_ends_of_a_mixture_are_those_of_its_draws() -> None:
    random, shifts, odds = np.random.default_rng(4), np.array([2.0, -0.5]), np.array([0.5, 0.25])
    means = random.choice([0.0, *shifts], size=400_000, p=np.array([1.0, *odds]) / 1.75)
    drawn = np.quantile(means + 0.3 * random.standard_normal(means.size), [0.025, 0.975])
    np.testing.assert_allclose(quantiles(shifts, odds, 0.3), drawn, atol=0.01)
    np.testing.assert_allclose(quantiles(np.zeros(0), np.zeros(0), 2.0), [-3.92, 3.92], atol=1e-3)


def test_an_interval_reaches_what_another_likely_choice_makes_of_a_gain(several) -> None:
    search, fit = several
    stiffer = fit.with_values(kp=1.5 * fit.point["kp"])
    sure = covariance(search, fit)
    ends = {}
    for likely in (0.0, 0.001, 0.4):
        found = replace(sure, others=alternatives([Other(("link.payload", ()), stiffer, likely)]))
        ends[likely] = interval(search, fit, found, 0, "kp")[1:3]
    assert ends[0.001] == ends[0.0]
    assert ends[0.4][1] > stiffer.point["kp"][0] > ends[0.0][1]
    found = replace(
        sure, others=alternatives([Other(("link.payload", ()), fit.with_values(kp=3 * fit.point["kp"]), 0.4)])
    )
    assert undecided_scale(search, fit, found) == [0, 1]


def test_an_effect_in_doubt_is_absent_from_its_share_of_the_draws(several) -> None:
    search, fit = several
    smooth = without_group(search, fit, ("friction.coulomb", (0,)))
    others = alternatives([Other(("friction.coulomb", (0,)), smooth, 0.3)])
    found = Covariance([(0, "coulomb"), (1, "coulomb")], np.diag([1e-6, 1e-6]), others=others)
    rows = draw(search, fit, found, 400, seed=2)
    absent = [row["shoulder.coulomb"] == search.nominal["coulomb"][0] for row in rows]
    assert 0.23 < np.mean(absent) < 0.37
    assert not any(row["elbow.coulomb"] == search.nominal["coulomb"][1] for row in rows)
