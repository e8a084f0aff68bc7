"""Fits within bounds, promises and choices of effects, against least squares of the columns themselves."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from gcomp.estimate.choice import EffectChoice
from gcomp.estimate.linear_terms import PRICE, Effect, LinearTerms, price_of

FOLDS, ROWS = 5, 200


def terms(x: np.ndarray, y: np.ndarray, low: float = -np.inf, high: float = np.inf) -> LinearTerms:
    """One channel, every row an independent measurement, hardly any prior."""
    fold = np.arange(len(y)) * FOLDS // len(y)
    parts = [fold == f for f in range(FOLDS)]
    size = x.shape[1]
    totals = np.array([[float(y[p] @ y[p]) for p in parts]])
    counts = np.array([[float(p.sum()) for p in parts]])
    squares, products = (np.stack([x[p].T @ x[p] for p in parts]),), (np.stack([-x[p].T @ y[p] for p in parts]),)
    none, floor = np.zeros(size), np.array([1e-6])
    return LinearTerms(
        none, (np.arange(size),), squares, products, totals, counts, np.array([1.0]), floor, none,
        np.full(size, 1e-12), none, np.full(size, low), np.full(size, high),
    )  # fmt: skip


def singles(size: int) -> dict[str, Effect[str]]:
    return {f"e{k}": Effect(f"e{k}", (k,)) for k in range(size)}


@pytest.mark.parametrize("seed", range(5))
def test_a_fit_within_bounds_is_that_of_least_squares_with_bounds(seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.normal(size=(ROWS, 6))
    y = x @ random.normal(0.0, 1.5, 6) + 0.1 * random.normal(size=ROWS)
    found = terms(x, y, -1.0, 1.0).fit(range(6))
    np.testing.assert_allclose(found, lsq_linear(x, y, (-1.0, 1.0)).x, atol=1e-6)
    assert set(terms(x, y, -1.0, 1.0).at_bounds(found)) == set(np.flatnonzero(np.abs(found) >= 1.0))


def test_what_is_held_by_equal_bounds_stays_there_and_the_others_are_fitted_beside_it() -> None:
    random = np.random.default_rng(1)
    x, own = random.normal(size=(ROWS, 3)), terms(random.normal(size=(ROWS, 3)), random.normal(size=ROWS))
    y = x @ np.array([1.0, 2.0, 3.0])
    own = terms(x, y)
    assert own.low is not None
    assert own.high is not None
    own.low[1] = own.high[1] = 5.0
    found = own.fit(range(3))
    expected = np.linalg.lstsq(x[:, [0, 2]], y - 5.0 * x[:, 1], rcond=None)[0]
    np.testing.assert_allclose(found[[0, 2]], expected, atol=1e-6)
    assert found[1] == 5.0


def test_a_candidate_that_would_need_an_impossible_value_promises_nothing() -> None:
    random = np.random.default_rng(2)
    x = random.normal(size=(ROWS, 2))
    y = -2.0 * x[:, 0] + x[:, 1]
    linear = terms(x, y, 0.0)
    below, above = linear.promises([], [(0,), (1,)])
    assert below == 0.0
    before, after = (linear.left(linear.fit(free)).sum() for free in ([], [1]))
    assert above == pytest.approx(0.5 * linear.counts.sum() * np.log(before / after), rel=1e-3)


def test_a_promise_is_the_fall_of_the_cost_with_the_free_parameters_adapting() -> None:
    random = np.random.default_rng(4)
    x = random.normal(size=(ROWS, 6)) @ random.normal(size=(6, 6))
    linear = terms(x, x @ random.normal(size=6) + 0.1 * random.normal(size=ROWS))
    left = [linear.left(linear.fit([0, 1, *more])).sum() for more in ([], [2], [3, 4])]
    falls = 0.5 * linear.counts.sum() * np.log(left[0] / np.array(left[1:]))
    assert linear.promises([0, 1], [(2,), (3, 4)]) == pytest.approx(falls, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_the_effects_that_act_are_chosen_and_no_others(seed: int) -> None:
    random = np.random.default_rng([seed, 3])
    x = random.normal(size=(ROWS, 20))
    acting = set(random.choice(20, 3, replace=False).tolist())
    y = sum(random.choice([-1.0, 1.0]) * x[:, k] for k in acting) + 0.3 * random.normal(size=ROWS)
    choice = EffectChoice(terms(x, y), singles(20))
    assert set(choice.run()) == {f"e{k}" for k in acting}


def test_two_effects_of_which_neither_pays_alone_enter_together() -> None:
    """Their difference shows, and each alone is all but at right angles to it."""
    random = np.random.default_rng(4)
    common, own, noise = random.normal(size=(3, ROWS))
    x = np.stack([common + 0.05 * own, common - 0.05 * own], axis=1)
    y = own + 0.2 * noise
    choice = EffectChoice(terms(x, y), singles(2))
    assert not choice.forward()
    assert sorted(choice.run()) == ["e0", "e1"]


def test_an_effect_that_costs_nothing_and_is_not_missed_leaves() -> None:
    random = np.random.default_rng(5)
    x = random.normal(size=(ROWS, 2)) * np.array([1.0, 0.0])
    y = x[:, 0] + 0.2 * random.normal(size=ROWS)
    effects = singles(2) | {"e1": Effect("e1", (1,), price=0.0)}
    assert EffectChoice(terms(x, y, 0.0), effects, ["e0", "e1"]).run() == ["e0"]


def test_an_effect_brings_what_it_needs_and_puts_out_what_it_excludes() -> None:
    own = terms(np.eye(ROWS)[:, :3], np.zeros(ROWS))
    effects = {
        "base": Effect("base", (0,)),
        "more": Effect("more", (1,), needs=("base",)),
        "other": Effect("other", (2,), excludes=frozenset({"more"})),
    }
    choice = EffectChoice(own, effects)
    assert choice.with_needs("more", []) == ["base", "more"]
    assert choice.with_needs("other", ["base", "more"]) == ["base", "other"]
    assert choice.without("base", ["base", "more"]) == []
    assert price_of(effects["more"]) == PRICE
