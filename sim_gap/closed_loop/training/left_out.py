"""Fits to all training recordings but one: what they leave of that one, and how far the parameters go from one to the
next.

Noise within a recording says little of how sure a parameter is: each motion shows what the model lacks in another way,
and the parameters take it up. Where there are several recordings their own spread is added, by the jackknife.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from gcomp.arrays import Array
from sim_gap.closed_loop.fit import Fit, batch, improve, residuals
from sim_gap.closed_loop.judge import Covariance, coordinate
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.windows import of_windows

FOLDS, STEPS = 3, 3
"""Parts of a single recording of which each is left out of a fit, and the steps of such a fit."""
LEAST_FREEDOM = 2
"""Degrees of freedom that are counted at least: two recordings alone have one, whose 95 % are 13 standard errors."""
SHARE = 0.975
"""Quantile of Student's distribution that the spread is widened to, as its estimate rests on few recordings."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A fit without each group of training windows: without each recording, or each third of a single one."""

    groups: NDArray[np.intp]
    """Number of the group of each window, (W,)."""
    fits: tuple[Fit, ...]
    """The fit without each group, in their order."""
    recordings: bool
    """Whether the groups are recordings."""


def left_out(search: Search, fit: Fit) -> LeftOut:
    """A fit to all other windows for each group of them."""
    data, groups = search.data, search.data.recording
    several = len(np.unique(groups)) > 1
    if not several:
        groups = np.arange(data.count) * FOLDS // data.count
    fits = []
    for group in np.unique(groups):
        others = np.flatnonzero(groups != group)
        fits.append(
            improve(of_windows(data, others), replace(fit, rms=None), search.scales, STEPS) if len(others) else fit
        )
    return LeftOut(groups, tuple(fits), several)


def gaps_left_out(search: Search, left: LeftOut) -> Array:
    """What is left of each training window by the fit without its group, (To, J, W) [rad]."""
    out = np.zeros_like(search.data.measured)
    for group, alone in zip(np.unique(left.groups), left.fits, strict=True):
        own = np.flatnonzero(left.groups == group)
        out[..., own] = residuals(of_windows(search.data, own), batch([alone.point]))[0]
    return out


def between_recordings(search: Search, spread: Covariance, left: LeftOut) -> Covariance:
    """The covariance with the spread from recording to recording added; as it is where there is a single one."""
    if not left.recordings or not spread.names:
        return spread
    at = np.array([[coordinate(search, alone, j, name) for j, name in spread.names] for alone in left.fits])
    apart, count = at - at.mean(0), len(at)
    few = float(t.ppf(SHARE, max(count - 1, LEAST_FREEDOM)) / norm.ppf(SHARE))
    return replace(spread, matrix=spread.matrix + few**2 * (count - 1) / count * apart.T @ apart)
