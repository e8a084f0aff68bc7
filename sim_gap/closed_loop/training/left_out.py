"""Fits to all training recordings but one, and what they leave of that one."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.closed_loop.fit import Fit, batch, improve, residuals
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.windows import Windows, of_windows

FOLDS, STEPS = 3, 3
"""Parts of a single recording of which each is left out of a fit, and the steps of such a fit."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A fit without each group of training windows: without each recording, or each third of a single one."""

    groups: NDArray[np.intp]
    """Number of the group of each window, (W,)."""
    fits: tuple[Fit, ...]
    """The fit without each group, in their order."""


def recordings_or_thirds(data: Windows) -> NDArray[np.intp]:
    """Number of the group of each window, (W,): its recording, or the third of a single one."""
    return np.arange(data.count) * FOLDS // data.count if data.of_one_recording else data.recording


def left_out(search: Search, fit: Fit) -> LeftOut:
    """A fit to all other windows for each group of them."""
    data, groups = search.data, recordings_or_thirds(search.data)
    fits = []
    for group in np.unique(groups):
        others = np.flatnonzero(groups != group)
        fits.append(
            improve(of_windows(data, others), replace(fit, rms=None), search.scales, STEPS) if len(others) else fit
        )
    return LeftOut(groups, tuple(fits))


def gaps_left_out(search: Search, left: LeftOut) -> Array:
    """What is left of each training window by the fit without its group, (To, J, W) [rad]."""
    out = np.zeros_like(search.data.measured)
    for group, alone in zip(np.unique(left.groups), left.fits, strict=True):
        own = np.flatnonzero(left.groups == group)
        out[..., own] = residuals(of_windows(search.data, own), batch([alone.point]))[0]
    return out
