"""Most probable parameters of small problems whose answers are known."""

from collections.abc import Callable

import numpy as np
import pytest

from gcomp.estimate.problem import NORMAL, EstimationProblem, FittedParameter, Linearised, linearise
from gcomp.estimate.solve import solve

T = np.linspace(0.0, 3.0, 60)


def problem_of(
    predict: Callable[[np.ndarray], np.ndarray], parameters: tuple[FittedParameter, ...], freedom: float = NORMAL
) -> EstimationProblem:
    rows = predict(np.array([p.nominal for p in parameters]))
    block = np.zeros(rows.shape[1], np.intp)
    floor = np.full(len(rows), 1e-6)
    return EstimationProblem(
        parameters,
        lambda thetas: np.stack([predict(theta) for theta in thetas]),
        np.ones(rows.shape),
        block,
        floor,
        freedom,
    )


def decay(channels: int, calls: list[int], bad: int = 0) -> EstimationProblem:
    """Each channel a decay of its own: size 2 and rate 1.3, as logarithms; the first rows of each may be far off."""

    def predict(theta: np.ndarray) -> np.ndarray:
        calls.append(1)
        own = theta.reshape(channels, 2)
        left = np.exp(own[:, :1] - np.exp(own[:, 1:]) * T) - 2.0 * np.exp(-1.3 * T)
        left[:, :bad] += 5.0
        return left

    names = [
        FittedParameter(name, 0.0, 3.0, channel=c, step=0.02) for c in range(channels) for name in ("size", "rate")
    ]
    return problem_of(predict, tuple(names), NORMAL if not bad else 4.0)


@pytest.mark.parametrize("bad", [0, 3])
def test_a_decay_is_found_by_the_derivatives_of_its_start(bad: int) -> None:
    """Those by differences at each of six steps would take six times as many evaluations as parameters, and six."""
    calls: list[int] = []
    problem = decay(3, calls, bad)
    calls.clear()
    found = solve(problem, np.full(6, -0.5), range(6), 8)
    np.testing.assert_allclose(found, 3 * [np.log(2.0), np.log(1.3)], atol=0.02)
    assert len(calls) < 18


def test_derivatives_that_lead_astray_are_found_again() -> None:
    problem = decay(1, [])
    start = np.array([0.2, 0.0])
    about = linearise(problem, start, range(2))
    wrong = Linearised(about.theta, about.residual, about.acting, tuple(-x for x in about.slopes))
    np.testing.assert_allclose(solve(problem, start, range(2), 8, wrong), [np.log(2.0), np.log(1.3)], atol=0.02)


def test_a_step_that_a_bound_bends_still_lowers_the_cost() -> None:
    """Two columns that nearly cancel, of which one may not fall below nothing."""
    columns = np.stack([np.sin(T), np.sin(T) + 0.05 * np.cos(T)])
    aim = 0.8 * columns[0] - 0.02 * np.cos(T)

    def predict(theta: np.ndarray) -> np.ndarray:
        return (theta @ columns - aim)[None]

    parameters = tuple(FittedParameter(name, 0.0, 100.0, 0.0, channel=0) for name in "ab")
    found = solve(problem_of(predict, parameters), np.array([0.1, 0.6]), range(2), 8)
    best = float(columns[0] @ aim / (columns[0] @ columns[0]))
    np.testing.assert_allclose(found, [best, 0.0], atol=0.02)


def test_derivatives_that_follow_a_step_agree_with_it() -> None:
    problem = decay(2, [])
    start, end = np.zeros(4), np.array([0.1, -0.2, 0.3, 0.0])
    about = linearise(problem, start, range(4))
    after = problem.predict(end[None])[0]
    moved = about.moved(end, after, np.ones_like(after))
    for c, (index, slopes) in enumerate(zip(moved.acting, moved.slopes, strict=True)):
        np.testing.assert_allclose((end - start)[index] @ slopes, after[c] - about.residual[c], atol=1e-12)
