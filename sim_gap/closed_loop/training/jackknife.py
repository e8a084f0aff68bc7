"""The jackknife: where parameters go when a group of windows is left out, a recording or a single window.

They follow in one Gauss-Newton step (Bell and McCaffrey, Survey Methodology 28, 2002), as far as the others let them
and as far as it lowers what is left of the others: along a direction that these hardly show a step is as long as the
prior lets it be, and motion is not linear over that.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from gcomp.arrays import Array, Mask
from sim_gap.closed_loop.fit import Fit, batch, coordinate, jacobian, residuals, stepped
from sim_gap.closed_loop.search import Search

ALONE = 0.03
"""Share of the information about a direction that the others are taken to have at least, without a group."""
ROUNDING = 1e-12
"""Information that every direction has, as a share of that about a parameter by itself."""
SHARES = 1.0, 0.5, 0.25, 0.125, 0.0
"""Shares of a step of which the best is taken."""


@dataclass(frozen=True, eq=False)
class Terms:
    """Normal equations of each window, at all joints; of W windows and K parameters."""

    names: list[tuple[int, str]]
    squares: Array
    """(W, K, K)."""
    scores: Array
    """(W, K)."""
    weights: Array
    """Of the squares that each joint leaves, (J,)."""


def terms_of(search: Search, fit: Fit) -> Terms:
    """Normal equations of each window of the search about a fit."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, fit.shared)
    names = [(j, name) for j, own in enumerate(fit.active) for name in own] + [(-1, name) for name in fit.shared]
    starts = np.concatenate([[0], np.cumsum([len(own) for own in fit.active])]).astype(int)
    size, count = len(names), search.data.count
    squares, scores = np.zeros((count, size, size)), np.zeros((count, size))
    weights = search.samples / np.maximum((now**2).sum((0, 2)), 1e-300)
    for j, x in enumerate(slopes):
        index = np.concatenate([np.arange(starts[j], starts[j + 1]), np.arange(starts[-1], size)]).astype(int)
        squares[np.ix_(np.arange(count), index, index)] += weights[j] * np.einsum("atw,btw->wab", x, x)
        scores[:, index] += weights[j] * np.einsum("atw,tw->wa", x, now[:, j])
    return Terms(names, squares, scores, weights)


def jackknifed(search: Search, free: Fit, terms: Terms, known: Array, groups: NDArray[np.intp]) -> Array:
    """Covariance by leaving out one group of windows after the other, (K, K); `known` is what is known beforehand."""
    steps = [
        shortened(search, free, terms, known, step, groups != label)
        for label, step in zip(np.unique(groups), steps_without(terms, known, groups), strict=True)
    ]
    return scatter(np.stack(steps))


def steps_without(terms: Terms, known: Array, groups: NDArray[np.intp]) -> Array:
    """The step of the parameters without each group, (G, K).

    Where nearly all that is known of a direction is in one group, such as the limit of a speed that is reached in a
    single motion, the step of the others would be noise over nothing.
    """
    squares, scores = terms.squares.sum(0) + known, terms.scores.sum(0)
    scale = 1.0 / np.sqrt(np.diag(squares))
    least = ROUNDING * np.eye(len(known))
    whole = squares * scale * scale[:, None] + least
    steps = []
    for own in (groups == label for label in np.unique(groups)):
        others = (squares - terms.squares[own].sum(0)) * scale * scale[:, None] + least
        told, directions = eigh(others, whole)
        step = directions.T @ (scale * (terms.scores[own].sum(0) - scores)) / np.maximum(told, ALONE)
        steps.append(scale * (directions @ step))
    return np.stack(steps)


def scatter(steps: Array) -> Array:
    """Covariance (K, K) of the whole from the steps without each of G groups (G, K)."""
    apart = steps - steps.mean(0)
    return np.asarray((len(steps) - 1) / len(steps) * apart.T @ apart)


def shortened(search: Search, free: Fit, terms: Terms, known: Array, step: Array, others: Mask) -> Array:
    """What the part of a step moves each parameter by that lowers most what is left of the `others` of the windows.

    It is of each joint by itself, unless the whole arm shares something.
    """
    joints = np.array([j for j, _ in terms.names])
    parts = [np.flatnonzero(joints == j) for j in range(search.data.joints)]
    common = np.flatnonzero(joints < 0)
    points = [
        stepped(search.data, free, search.scales, free.active, [share * step[at] for at in parts], share * step[common])
        for share in SHARES
    ]
    left = residuals(search.data, batch(points))[..., others]
    cost = terms.weights * np.einsum("ptjw,ptjw->pj", left, left)
    cost += np.square(SHARES)[:, None] * [step[at] @ known[np.ix_(at, at)] @ step[at] for at in parts]
    if len(common):
        rest = step @ known @ step - sum(step[at] @ known[np.ix_(at, at)] @ step[at] for at in parts)
        cost = np.broadcast_to((cost.sum(1) + np.square(SHARES) * rest)[:, None], cost.shape)
    best = cost.argmin(0)
    return np.array(
        [
            coordinate(replace(free, point=points[best[j]]), search.scales, j, name)
            - coordinate(free, search.scales, j, name)
            for j, name in terms.names
        ]
    )
