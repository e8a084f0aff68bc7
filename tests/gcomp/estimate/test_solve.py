"""Steps to the most probable parameters, with derivatives that are exact, coarse or wrong."""

from collections.abc import Callable

import numpy as np
import pytest

from gcomp.arrays import Array
from gcomp.estimate.problem import EstimationProblem, FittedParameter
from gcomp.estimate.solve import solve

TIME = np.linspace(0.0, 4.0, 200)
TRUE = np.array([[1.0, 1.3, 0.8, 1.1, 0.5], [1.2, 0.9, 1.4, 0.7, 0.4]])


def motion(theta: Array) -> Array:
    """Two channels of a decay, two waves and a drift, (2, N)."""
    return np.stack(
        [a * np.exp(-b * TIME) + c * np.sin(TIME) + d * np.cos(2.0 * TIME) + e * TIME for a, b, c, d, e in theta]
    )


def problem_of(counts: list[int], cheaper: Callable[[Array], Array] | None = None) -> EstimationProblem:
    """`counts` gets the number of points of each exact prediction."""
    measured = motion(TRUE) + 0.01 * np.random.default_rng(3).standard_normal((2, len(TIME)))
    parameters = tuple(FittedParameter(name, 1.0, 10.0, channel=c) for c in range(2) for name in "abcde")

    def predict(thetas: Array) -> Array:
        counts.append(len(thetas))
        return np.stack([motion(theta.reshape(2, 5)) - measured for theta in thetas])

    unknown = np.zeros(len(TIME), np.intp)
    return EstimationProblem(parameters, predict, np.ones((2, len(TIME))), unknown, np.full(2, 1e-3), cheaper=cheaper)


def coarse(thetas: Array) -> Array:
    """Derivatives that are a tenth too large, about another point."""
    return np.stack([1.1 * motion(theta.reshape(2, 5)) + 0.3 for theta in thetas])


def wrong(thetas: Array) -> Array:
    return np.stack([-motion(theta.reshape(2, 5)) for theta in thetas])


@pytest.mark.parametrize(("cheaper", "exact"), [(None, 12), (coarse, 9), (wrong, 12)])
def test_derivatives_serve_for_several_steps_and_coarse_ones_as_well(
    cheaper: Callable[[Array], Array] | None, exact: int
) -> None:
    """Taken afresh at each of five steps, the derivatives by five parameters would take 25 predictions."""
    counts: list[int] = []
    fit = solve(problem_of(counts, cheaper), np.ones(10), range(10), 5)
    assert fit.theta.reshape(2, 5) == pytest.approx(TRUE, abs=0.02)
    assert np.sqrt(np.mean(fit.residual**2)) == pytest.approx(0.01, rel=0.1)
    assert sum(counts) <= exact
