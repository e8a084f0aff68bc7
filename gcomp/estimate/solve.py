"""Most probable parameters: damped Gauss-Newton steps with Student's t instead of a normal distribution.

A row far off, as of a moment of contact, then counts little, with no threshold.
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.problem import EstimationProblem, Linearised, linearise

STILL = 1e-3
"""Relative fall of a channel's cost below which its fit ends."""
LONGEST_STEP = 1.5
"""Longest step of a parameter, in its own coordinate."""
SHORTENED = 6
"""Steps that are tried, each shorter, before a fit ends."""
LEAST_DAMPING, HARDER = 1e-3, 10.0
"""Damping of a step, over the curvature of the cost, and factor on it where the step does not lower the cost."""


def robust_weight(residual: Array, variance: Array, freedom: float) -> Array:
    """1 for a row well within the scale and less for one far off, (C, N)."""
    return (freedom + 1.0) / (freedom + residual**2 / variance[:, None])


def scale_of(problem: EstimationProblem, residual: Array) -> Array:
    """Variance of each channel under Student's t, by fixed-point iteration from the mean square, (C,)."""
    count = np.maximum(problem.weight.sum(1), 1e-300)
    variance = (problem.weight * residual**2).sum(1) / count + problem.floor**2
    for _ in range(20):
        weight = problem.weight * robust_weight(residual, variance, problem.freedom)
        variance = (weight * residual**2).sum(1) / count + problem.floor**2
    return np.asarray(variance)


def cost_of(problem: EstimationProblem, residual: Array, variance: Array) -> Array:
    """Negative logarithm of the likelihood of each channel but for a constant, (C,)."""
    spread = np.log1p(residual**2 / (problem.freedom * variance[:, None]))
    return np.asarray(
        (0.5 * (problem.freedom + 1.0) * problem.weight * spread).sum(1)
        + 0.5 * problem.weight.sum(1) * np.log(variance)
    )


def solve(
    problem: EstimationProblem,
    theta: Array,
    free: Sequence[int],
    iterations: int = 6,
    about: Linearised | None = None,
) -> Array:
    """The most probable values of the free parameters from `theta` on, (K,).

    Derivatives are found once, or are those given `about` this point, and follow the steps (`Linearised.moved`); they
    are found again where no step by them lowers the cost. Where no parameter acts on all channels, each takes its own
    steps.
    """
    free = list(free)
    own = np.array([problem.parameters[k].channel for k in free], np.intp)
    together = bool(np.any(own < 0))
    channels = len(problem.weight)
    enough = STILL * np.maximum(problem.weight.sum(1), 1.0)
    theta = problem.within(np.array(theta, float))
    now = problem.predict(theta[None])[0] if about is None else about.residual
    busy, fresh = np.isin(np.arange(channels), own) | together, False
    for _ in range(iterations):
        if about is None:
            about, fresh = linearise(problem, theta, free, now), True
        variance = scale_of(problem, now)
        before = cost_of(problem, now, variance) + prior_cost(problem, theta, channels)
        weight = problem.weight * robust_weight(now, variance, problem.freedom) / variance[:, None]
        damping, trial, higher = np.full(channels, LEAST_DAMPING), theta.copy(), busy
        for _ in range(SHORTENED):
            step = _step(problem, about, weight, damping)
            promised = _promised(about, weight, step)
            promised = np.full(channels, promised.sum() / channels) if together else promised
            if not (busy & (promised < 0.0)).any():
                break
            damping[promised < 0.0] *= HARDER  # a bound shortens it otherwise
        busy = higher = busy & (promised > enough)
        if not busy.any():
            break
        for _ in range(SHORTENED if fresh else 1):
            moving = [k for k, c in zip(free, own, strict=True) if higher[c]]
            trial[moving] = (theta + step)[moving]
            left = problem.predict(trial[None])[0]
            after = cost_of(problem, left, variance) + prior_cost(problem, trial, channels)
            higher = busy & ((after >= before) if not together else (after.sum() >= before.sum()))
            if not higher.any():
                break
            damping *= HARDER
            step = _step(problem, about, weight, damping)
        there = theta.copy()
        taken = [k for k, c in zip(free, own, strict=True) if (busy & ~higher)[c]]
        there[taken] = trial[taken]
        now = left if np.array_equal(there, trial) else problem.predict(there[None])[0] if taken else now
        about, theta = about.moved(there, now, weight) if taken else about, there
        if higher.any() and not fresh:
            about = None
            continue
        busy, fresh = busy & ~higher, False
    return theta


def _promised(about: Linearised, weight: Array, step: Array) -> Array:
    """Fall of each channel's cost by a step (K,) to first order, (C,)."""
    linear = about.residual + np.stack([step[i] @ x for i, x in zip(about.acting, about.slopes, strict=True)])
    return np.asarray(0.5 * (weight * (about.residual**2 - linear**2)).sum(1))


def prior_cost(problem: EstimationProblem, theta: Array, channels: int) -> Array:
    """Cost of parameters away from their nominal values by channel; of those of all channels at the first, (C,)."""
    out = np.zeros(channels)
    for value, p in zip(theta, problem.parameters, strict=True):
        if np.isfinite(p.nominal) and np.isfinite(p.prior_std):
            out[max(p.channel, 0)] += 0.5 * ((value - p.nominal) / p.prior_std) ** 2
    return out


def precision(problem: EstimationProblem) -> Array:
    """Inverse variance of each parameter before any measurement, (K,)."""
    return np.array([1.0 / p.prior_std**2 if np.isfinite(p.nominal) else 0.0 for p in problem.parameters])


def _step(problem: EstimationProblem, about: Linearised, weight: Array, damping: Array) -> Array:
    """Step of all free parameters within their bounds, (K,)."""
    size = len(problem.parameters)
    normal, right, prior = np.zeros((size, size)), np.zeros(size), precision(problem)
    damped = np.zeros(size)
    for c, (index, x) in enumerate(zip(about.acting, about.slopes, strict=True)):
        square = (x * weight[c]) @ x.T
        normal[np.ix_(index, index)] += square
        right[index] -= (x * weight[c]) @ about.residual[c]
        damped[index] += damping[c] * np.diag(square)
    free = np.unique(np.concatenate(about.acting)) if about.acting else np.zeros(0, np.intp)
    away = np.where(prior > 0.0, np.nan_to_num(problem.nominal) - about.theta, 0.0)
    own = normal[np.ix_(free, free)] + np.diag(prior[free] + damped[free])
    own[np.diag_indices(len(free))] += 1e-9 * max(float(np.diag(own).max(initial=0.0)), 1e-30)
    step = np.zeros(size)
    step[free] = np.linalg.solve(own, right[free] + prior[free] * away[free])
    return problem.within(about.theta + np.clip(step, -LONGEST_STEP, LONGEST_STEP)) - about.theta
