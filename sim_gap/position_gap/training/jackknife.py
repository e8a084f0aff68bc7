"""Windows left out: where parameters go without a group of windows, and what fits to the others leave of it.

The parameters follow in one Gauss-Newton step (Bell and McCaffrey, Survey Methodology 28, 2002), as
far as the others let them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from gcomp.arrays import Array
from sim_gap.position_gap.choice import LoopSearch
from sim_gap.position_gap.fit import LoopFit, jacobian, names_of
from sim_gap.position_gap.windows import Windows

FARTHEST = 1.5
"""Longest step of a parameter without a group, in its own coordinate."""
ALONE = 0.03
"""Share of the information about a direction that the others are taken to have at least, without a group."""
LEAST_INFORMATION = 1e-12
"""Information that every direction has, as a share of that about a parameter by itself."""


@dataclass(frozen=True, eq=False)
class WindowTerms:
    """Normal equations of each window, at all joints; of W windows and K parameters."""

    names: list[tuple[int, str]]
    squares: Array
    """(W, K, K)."""
    scores: Array
    """(W, K)."""
    residual: Array
    """(To, J, W)."""
    slopes: list[Array]
    """Derivatives of each joint, (K_j + S, To, W)."""


def terms_of(search: LoopSearch, fit: LoopFit) -> WindowTerms:
    """Normal equations of each window of the search about a fit."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, fit.shared)
    names = names_of(fit)
    size, count, weight = len(names), search.data.count, search.data.weight
    squares, scores = np.zeros((count, size, size)), np.zeros((count, size))
    weights = search.samples / np.maximum((now**2 * weight).sum((0, 2)), 1e-300)
    for j, x in enumerate(slopes):
        index = acting(names, j)
        counted = x * weight[:, j]
        squares[np.ix_(np.arange(count), index, index)] += weights[j] * np.einsum("atw,btw->wab", counted, x)
        scores[:, index] += weights[j] * np.einsum("atw,tw->wa", counted, now[:, j])
    return WindowTerms(names, squares, scores, now, slopes)


def acting(names: Sequence[tuple[int, str]], joint: int) -> NDArray[np.intp]:
    """Numbers of the parameters that act on a joint: its own and those of the whole arm."""
    return np.array([k for k, (j, _) in enumerate(names) if j in (joint, -1)], np.intp)


def jackknifed(terms: WindowTerms, known: Array, groups: NDArray[np.intp]) -> Array:
    """Covariance (K, K) by leaving out one group of windows after the other; `known` is what is known beforehand.

    Where nearly all that is known of a direction is in one group, such as the limit of a speed that is reached in a
    single motion, the step of the others would be noise over nothing.
    """
    squares, scores = terms.squares.sum(0) + known, terms.scores.sum(0)
    scale = 1.0 / np.sqrt(np.diag(squares))
    least = LEAST_INFORMATION * np.eye(len(known))
    whole = squares * scale * scale[:, None] + least
    steps = []
    for own in (groups == label for label in np.unique(groups)):
        others = (squares - terms.squares[own].sum(0)) * scale * scale[:, None] + least
        told, directions = eigh(others, whole)
        step = directions.T @ (scale * (terms.scores[own].sum(0) - scores)) / np.maximum(told, ALONE)
        steps.append(scale * (directions @ step))
    apart = np.stack(steps) - np.mean(steps, axis=0)
    return np.asarray((len(steps) - 1) / len(steps) * apart.T @ apart)


FOLDS = 3
"""Parts of a single recording of which each is left out of a fit."""


def recordings_or_thirds(data: Windows) -> NDArray[np.intp]:
    """Number of the group of each window, (W,): its recording, or the third of a single one."""
    return np.arange(data.count) * FOLDS // data.count if data.of_one_recording else data.recording


def gaps_left_out(data: Windows, terms: WindowTerms, known: Array) -> Array:
    """Gap that a fit without its group leaves of each training window, to first order, (To, J, W) [rad]."""
    groups, out = recordings_or_thirds(data), terms.residual.copy()
    whole = terms.squares.sum(0) + known
    for group in np.unique(groups) if len(terms.names) else ():
        own = np.flatnonzero(groups == group)
        others = whole - terms.squares[own].sum(0)
        step = np.linalg.lstsq(others, terms.scores[own].sum(0) - terms.scores.sum(0), rcond=1e-9)[0]
        step = np.clip(step, -FARTHEST, FARTHEST)
        for j, x in enumerate(terms.slopes):
            out[:, j, own] += np.einsum("a,atw->tw", step[acting(terms.names, j)], x[..., own])
    return out
