"""Where parameters go without a part of the windows, and that they go no further than it lowers what is left."""

from dataclasses import replace

import numpy as np
import pytest
from servo_arm import fitted

from sim_gap.closed_loop.coordinates import moved
from sim_gap.closed_loop.fit import Fit, batch, residuals
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.training.jackknife import Terms, jackknifed, scatter, shortened, steps_without, terms_of


@pytest.fixture(scope="module")
def arm() -> tuple[Search, Fit]:
    return fitted(0.15, 0.35)


def test_the_jackknife_is_that_of_the_text_books() -> None:
    """Of a mean of G values it is their variance over G."""
    values = np.array([0.15, 0.35, 0.2, 0.5])
    terms = Terms([(0, "coulomb")], np.ones((4, 1, 1)), (0.3 - values)[:, None], np.ones(1))
    found = scatter(steps_without(terms, np.zeros((1, 1)), np.arange(4)))
    assert found[0, 0] == pytest.approx(values.var(ddof=1) / 4.0)


def test_a_step_that_lowers_what_is_left_is_gone_and_any_other_shortened(arm) -> None:
    """From a gain that is a tenth too high back to the fitted one, and to an eighth of twelve times that step."""
    search, fit = arm
    away = 0.1
    high = replace(fit.with_values(kp=fit.point["kp"] * np.exp(away)), active=(("kp",), ("kp",)), rms=None)
    terms = terms_of(search, high)
    every, known = np.ones(search.data.count, bool), 1e-4 * np.eye(2)
    back = np.array([-away, -away])
    np.testing.assert_allclose(shortened(search, high, terms, known, back, every), back, rtol=1e-9)
    further = shortened(search, high, terms, known, np.array([-away, -12.0 * away]), every)
    np.testing.assert_allclose(further, [-away, -12.0 * away / 8.0], rtol=1e-9)
    np.testing.assert_array_equal(shortened(search, high, terms, known, -back, every), np.zeros(2))


def test_without_a_group_no_parameter_goes_where_the_others_are_left_worse(arm) -> None:
    """Recordings that contradict one another in all, of which one says little: its step alone would go far."""
    search, fit = arm
    terms, groups = terms_of(search, fit), search.data.recording
    known = np.zeros((len(terms.names),) * 2)
    now = residuals(search.data, batch([fit.point]))[0]
    for label, step in zip(np.unique(groups), steps_without(terms, known, groups), strict=True):
        others = groups != label
        gone = shortened(search, fit, terms, known, 4.0 * step, others)
        point = {name: values.copy() for name, values in fit.point.items()}
        for (j, name), size in zip(terms.names, gone, strict=True):
            point[name][j] = moved(name, point[name][j], size, search.scales, j)
        left = residuals(search.data, batch([point]))[0]
        squares = (left[..., others] ** 2).sum((0, 2)), (now[..., others] ** 2).sum((0, 2))
        assert (squares[0] <= squares[1] * (1.0 + 1e-9)).all()
    assert np.linalg.eigvalsh(jackknifed(search, fit, terms, known, groups)).min() > -1e-12
