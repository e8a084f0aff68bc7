"""Most probable parameters: damped Gauss-Newton steps with Student's t instead of a normal distribution.

A row far off, as of a moment of contact, then counts little, with no threshold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.problem import EstimationProblem, Linearised, linearise

STILL = 1e-3
"""Relative fall of a channel's cost below which its fit ends."""
SHORT_OF = 0.5
"""Share of the fall that derivatives promise, below which they are taken afresh."""
LONGEST_STEP = 1.5
"""Longest step of a parameter, in its own coordinate."""
SHORTENED = 6
"""Times that a step is shortened before a fit ends."""
EASIER, HARDER = 0.2, 10.0
"""Factors on the damping after a step that lowers the cost, and after one that does not."""


@dataclass(frozen=True, eq=False)
class RobustFit:
    theta: Array
    residual: Array
    """(C, N)."""
    variance: Array
    """Square of the scale of the residuals, (C,)."""


def robust_weight(residual: Array, variance: Array, freedom: float) -> Array:
    """Weight of each row beside the others of its channel by Student's t, (C, N): less than 1 for one far off."""
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


def solve(problem: EstimationProblem, theta: Array, free: Sequence[int], iterations: int = 6) -> RobustFit:
    """The most probable values of the free parameters from `theta` (K,) on, in at most so many steps with derivatives
    by differences, and twice as many in all: the others are with those that followed from the steps before.

    Where no parameter acts on all channels, each channel takes its own steps.
    """
    free = list(free)
    shared = any(problem.parameters[k].channel < 0 for k in free)
    channels = len(problem.weight)
    damping, busy = np.full(channels, 1e-3), np.ones(channels, bool)
    theta = problem.within(np.array(theta, float))
    now: Array | None = None  # residual at theta, where it is known
    about: Linearised | None = None
    for _ in range(2 * iterations):
        moving = [k for k in free if shared or busy[problem.parameters[k].channel]]
        if not moving:
            break
        if fresh := about is None:
            if not iterations:
                break
            iterations -= 1
            about = linearise(problem, theta, moving, now)
        now = about.residual
        variance = scale_of(problem, now)
        before = cost_of(problem, now, variance) + prior_cost(problem, theta, channels)
        weight = problem.weight * robust_weight(now, variance, problem.freedom) / variance[:, None]
        for _ in range(SHORTENED if fresh else 1):
            step = np.zeros(len(theta))
            step[moving] = _step(problem, about, weight, damping)[moving]
            trial = problem.within(theta + step)
            left = problem.predict(trial[None])[0]
            after = cost_of(problem, left, variance) + prior_cost(problem, trial, channels)
            lower = after < before if not shared else np.full(channels, after.sum() < before.sum())
            damping = np.where(lower, damping * EASIER, damping * HARDER)
            if lower[busy].any():
                break
        fall = before - after
        promised = before - cost_of(problem, _expected(about, trial), variance) - prior_cost(problem, trial, channels)
        about = _with_secant(about, weight, trial, left)
        if lower.any():
            taken = [k for k in moving if lower[max(problem.parameters[k].channel, 0)]]
            theta[taken] = trial[taken]
            now = left if np.array_equal(theta, trial) else problem.predict(theta[None])[0]
            about = replace(about, theta=theta.copy(), residual=now)
        small = STILL * np.maximum(problem.weight.sum(1), 1.0)
        done = (fall < small) & (lower if fresh else lower & (promised < small)) | (damping > 1e3)
        busy = np.full(channels, not done.all()) if shared else busy & ~done
        if fresh and not lower.any():
            break
        serve = fall[busy].sum() >= SHORT_OF * promised[busy].sum()
        about = about if serve else None
    residual = problem.predict(theta[None])[0] if now is None else now
    return RobustFit(theta, residual, scale_of(problem, residual))


def _expected(about: Linearised, trial: Array) -> Array:
    """Residual at `trial` (K,) as the derivatives have it, (C, N)."""
    out = about.residual.copy()
    for c, (index, x) in enumerate(zip(about.acting, about.slopes, strict=True)):
        out[c] += (trial - about.theta)[index] @ x
    return out


def _with_secant(about: Linearised, weight: Array, trial: Array, left: Array) -> Linearised:
    """Derivatives that also lead to what was found at `trial`, the least changed (Broyden, Math. Comp. 19, 1965)."""
    missed, slopes = left - _expected(about, trial), []
    for c, (index, x) in enumerate(zip(about.acting, about.slopes, strict=True)):
        step = (trial - about.theta)[index]
        along = step * ((x**2) @ weight[c])
        length = float(along @ step)
        slopes.append(x + np.outer(along / length, missed[c]) if length > 0.0 else x)
    return replace(about, slopes=tuple(slopes))


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
    """Step of all free parameters, (K,)."""
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
    return np.clip(step, -LONGEST_STEP, LONGEST_STEP)
