"""Windows left out: where parameters go without a group of windows, and fits to all training recordings but one.

In the jackknife the parameters follow in one Gauss-Newton step (Bell and McCaffrey, Survey Methodology 28, 2002), as
far as the others let them.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, batch, improve, jacobian, residuals
from sim_gap.position_gap.search import LoopSearch
from sim_gap.position_gap.windows import Windows, choose_windows

ALONE = 0.03
"""Share of the information about a direction that the others are taken to have at least, without a group."""
LEAST_INFORMATION = 1e-12
"""Information that every direction has, as a share of that about a parameter by itself."""


@dataclass(frozen=True, eq=False)
class Terms:
    """Normal equations of each window, at all joints; of W windows and K parameters."""

    names: list[tuple[int, str]]
    squares: Array
    """(W, K, K)."""
    scores: Array
    """(W, K)."""


def terms_of(search: LoopSearch, fit: LoopFit) -> Terms:
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
    return Terms(names, squares, scores)


def jackknifed(terms: Terms, known: Array, groups: NDArray[np.intp]) -> Array:
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


FOLDS, STEPS = 3, 3
"""Parts of a single recording of which each is left out of a fit, and the steps of such a fit."""


@dataclass(frozen=True, eq=False)
class LeftOutFits:
    """A fit without each group of training windows: without each recording, or each third of a single one."""

    groups: NDArray[np.intp]
    """Number of the group of each window, (W,)."""
    fits: tuple[LoopFit, ...]
    """The fit without each group, in their order."""


def recordings_or_thirds(data: Windows) -> NDArray[np.intp]:
    """Number of the group of each window, (W,): its recording, or the third of a single one."""
    return np.arange(data.count) * FOLDS // data.count if data.of_one_recording else data.recording


def leave_out(search: LoopSearch, fit: LoopFit) -> LeftOutFits:
    """A fit to all other windows for each group of them."""
    data, groups = search.data, recordings_or_thirds(search.data)
    fits = []
    for group in np.unique(groups):
        others = np.flatnonzero(groups != group)
        fits.append(
            improve(choose_windows(data, others), replace(fit, rms=None), search.scales, STEPS) if len(others) else fit
        )
    return LeftOutFits(groups, tuple(fits))


def gaps_left_out(search: LoopSearch, left: LeftOutFits) -> Array:
    """Gap that the fit without its group leaves of each training window, (To, J, W) [rad]."""
    out = np.zeros_like(search.data.measured)
    for group, alone in zip(np.unique(left.groups), left.fits, strict=True):
        own = np.flatnonzero(left.groups == group)
        out[..., own] = residuals(choose_windows(search.data, own), batch([alone.point]))[0]
    return out
