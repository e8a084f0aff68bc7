"""A limit that no training motion reaches is drawn from there up: motion that asks for more is less sure, no other."""

from dataclasses import replace

import numpy as np
import pytest
from servo_arm import at_both, model_text, record, search_on

from sim_gap.position_gap.fit import LoopFit, LoopSearch
from sim_gap.position_gap.training import bands, unreached_limits
from sim_gap.position_gap.training.bands import band
from sim_gap.position_gap.training.spread import covariance, draw, gaps_left_out, known_before, terms_of

GAIN, FASTER = 15.0, 2.0
TEXT = model_text(kp=GAIN, friction=0.2)
FOUND = ("kp", "coulomb", "viscous")


def of(text: str) -> tuple[LoopSearch, LoopFit]:
    """Search and fit of a training recording of the arm without limits."""
    search = search_on(text, [record(TEXT, 1, 14.0)])
    return search, search.improve(LoopFit(search.nominal).freed(at_both(*FOUND)))


def left_out(search: LoopSearch, fit: LoopFit) -> np.ndarray:
    terms = terms_of(search, fit)
    return gaps_left_out(search.data, terms, known_before(search, fit))


@pytest.fixture(scope="module")
def arm() -> tuple[LoopSearch, LoopFit]:
    return of(TEXT)


def test_the_least_limit_is_what_the_training_motion_asks_for(arm) -> None:
    search, fit = arm
    torque = np.abs(GAIN * search.data.error).max(axis=(0, 2))
    found = {(each.joint, each.name): each.least for each in unreached_limits.find_unreached(search, fit)}
    assert found.keys() == {(j, name) for j in (0, 1) for name in ("limit", "slew")}
    for j in (0, 1):
        assert 0.8 < found[j, "limit"] / torque[j] < 1.05


def test_draws_go_from_there_to_ten_times_as_much(arm) -> None:
    search, fit = arm
    spread = replace(covariance(search, fit), limits=unreached_limits.find_unreached(search, fit))
    rows = draw(search, fit, spread, 2000)
    least = next(x.least for x in spread.limits if (x.joint, x.name) == (1, "limit"))
    drawn = np.log10(np.array([row["elbow.limit"] for row in rows]) / least)
    assert -0.15 < drawn.min() < 0.05
    assert 0.95 < drawn.max() < 1.1
    assert np.median(drawn) == pytest.approx(0.5, abs=0.06)
    bare = draw(search, fit, replace(spread, limits=()), 3)
    assert bare[0].items() <= draw(search, fit, spread, 3)[0].items()


def test_a_limit_that_is_stated_fitted_or_left_out_is_not_drawn(arm) -> None:
    search, fit = arm
    stated, own = of(TEXT.replace('kp="15.0"/>', 'kp="15.0" forcerange="-20 20"/>', 1))
    assert {(x.joint, x.name) for x in unreached_limits.find_unreached(stated, own)} == {
        (1, "limit"),
        (0, "slew"),
        (1, "slew"),
    }
    fitted = fit.with_values(slew=np.array([np.inf, 3.0]))
    withheld = replace(search, excluded=frozenset({"actuator.saturation"}))
    assert {(x.joint, x.name) for x in unreached_limits.find_unreached(withheld, fitted)} == {(0, "slew")}


@pytest.mark.long
def test_the_band_widens_where_motion_asks_for_more_and_nowhere_else(arm) -> None:
    search, fit = arm
    spread = replace(covariance(search, fit), limits=unreached_limits.find_unreached(search, fit))
    data = search.data
    wider = record(TEXT, 2, 14.0)
    assert wider.position_command is not None
    wider = replace(wider, position=FASTER * wider.position, position_command=FASTER * wider.position_command)
    faster = search_on(TEXT, [wider]).data
    others = left_out(search, fit)
    for heldout, widened in ((data, False), (faster, True)):
        without, within = (
            band(search, fit, replace(spread, limits=x), others, heldout).width for x in ((), spread.limits)
        )
        assert ((within > 1.5 * without) == widened).all()
        assert widened or (within < 1.1 * without).all()


@pytest.mark.long
@pytest.mark.parametrize("over", [1.1, 1.6, np.inf])
def test_the_band_holds_motion_beyond_the_training_whatever_the_limit_is(arm, over) -> None:
    search, fit = arm
    data = search.data
    torque = np.abs(GAIN * data.error).max(axis=(0, 2))
    real = model_text(kp=GAIN, friction=0.2, limits=over * torque if np.isfinite(over) else ())
    other = search_on(TEXT, [record(real, 3, 14.0, wide=1.5, fast=1.7)]).data
    spread = covariance(search, fit)
    others = left_out(search, fit)
    known, open_ = (
        band(search, fit, replace(spread, limits=x), others, other)
        for x in ((), unreached_limits.find_unreached(search, fit))
    )
    assert (open_.holds > 0.85).all()
    assert np.isinf(over) or (known.holds < 0.8).any()


@pytest.mark.parametrize(("apart", "factor"), [(0.0, 1.645), (0.5, 1.446), (20.0, 1.282)])
def test_the_band_about_two_simulations_holds_its_share_with_either(apart: float, factor: float) -> None:
    """Gaps of a normal distribution: apart by nothing two sides count, far apart one side; between them what solves
    F(a + f) - F(-f) = 0.9."""
    gaps = np.random.default_rng(4).normal(size=200_000)
    about = np.array([[0.0] * 50, [apart] * 50])
    assert 1.645 * bands._narrower(gaps, about, 1.645) == pytest.approx(factor, abs=0.04)
