"""Bands of closed-loop motion: what parameters that are not known, and what no parameter explains, leave open.

The band of a joint at each instant joins the spread that the covariance of all parameters brings and the spread of what
a fit leaves of recordings that it has not seen: one after the other is left out of the training ones. It is scaled so
that it holds its share of those. Of a limit that no training motion reaches nothing is known but where it may not lie,
so that the band goes about the simulations with every limit that the training motion admits. About all of them it would
hold more than its share, whichever is true: it is narrowed to what holds its share of the motion with each.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, LoopSearch, jacobian, joint_rms, root_mean_squares
from sim_gap.position_gap.simulation import simulate
from sim_gap.position_gap.training.spread import Covariance, recordings_or_thirds
from sim_gap.position_gap.training.unreached_limits import LIMITS, Unreached
from sim_gap.position_gap.windows import Windows

SHARE = 0.9
"""Share of the motion that a band should hold."""
ABOVE = (1.0, 1.5)
"""Limits about which the band goes, over the least that the training motion admits; without a limit too."""
OTHER_MOTION = 3.5
"""How many times as much as a single recording shows another motion leaves where all that is left of it lasts: 25
recordings of an SO-101, each fitted alone. It grows with the square of what lasts, for of what is left on simulated
arms, whose other motion leaves no more, up to a sixth does."""
NARROWER = np.linspace(0.0, 1.0, 51)
"""Factors on the band about several limits, of which the least is taken that holds its share."""


@dataclass(frozen=True, eq=False)
class Band:
    """Band about the corrected simulation, (J,) each."""

    holds: Array
    """Share of the held-out samples within it."""
    width: Array
    """RMS of half of its width on held-out motion [rad]."""
    unexplained: Array
    """Standard deviation of what no parameter explains [rad]: noise to add to the draws."""
    reach: Array
    """RMS of half of its width on the training motion, about a single simulation [rad]: how far draws go."""


def band(search: LoopSearch, fit: LoopFit, spread: Covariance, left: Array, heldout: Windows) -> Band:
    """The band that follows from the training windows of `search`, judged on the held-out ones.

    `left` is what fits without their recording leave of the training windows, (To, J, W) [rad].
    """
    data = search.data
    groups = recordings_or_thirds(data)
    each = root_mean_squares(data, left)
    unexplained = joint_rms(data, each)
    size = np.sqrt(_variance(search, fit, spread, data) + unexplained[:, None] ** 2)
    there = data.weight > 0.0
    factor = np.array([np.quantile((np.abs(left[:, j]) / size[:, j])[there[:, j]], SHARE) for j in range(data.joints)])
    wider = _uncertainty(np.stack([(each[:, groups == g] ** 2).mean(1) for g in np.unique(groups)]))
    if data.of_one_recording:
        wider *= 1.0 + (OTHER_MOTION - 1.0) * _lasting(left, data.weight) ** 2
    reach = factor * wider * np.sqrt((size**2 * data.weight).sum((0, 2)) / np.maximum(data.weight.sum((0, 2)), 1.0))
    about = simulate(heldout, [fit.point, *_with_limits(fit, spread.limits)])
    unit = wider[:, None] * np.sqrt(_variance(search, fit, spread, heldout) + unexplained[:, None] ** 2)
    for j in range(data.joints) if len(about) > 1 else ():
        gaps = (left[:, j] / size[:, j])[there[:, j]]
        shown = heldout.weight[:, j] > 0.0
        factor[j] *= _narrower(gaps, about[:, :, j][:, shown] / unit[:, j][shown], float(factor[j]))
    half = factor[:, None] * unit
    low, high = about.min(0) - half, about.max(0) + half
    counts = np.maximum(heldout.weight.sum((0, 2)), 1.0)
    within = (low <= heldout.measured) & (heldout.measured <= high)
    width = 0.5 * np.sqrt(((high - low) ** 2 * heldout.weight).sum((0, 2)) / counts)
    return Band((within * heldout.weight).sum((0, 2)) / counts, width, wider * unexplained, reach)


def _with_limits(fit: LoopFit, limits: Sequence[Unreached]) -> list[dict[str, Array]]:
    """The fit's point with each kind of limit at levels from the least that is admitted at every joint."""
    out = []
    for name in LIMITS:
        least = {each.joint: each.least for each in limits if each.name == name}
        for factor in ABOVE if least else ():
            values = fit.point[name].copy()
            values[list(least)] = factor * np.array(list(least.values()))
            out.append({**fit.point, name: values})
    return out


def _narrower(gaps: Array, about: Array, factor: float) -> float:
    """Least factor with which the band about all simulations holds SHARE of the motion, whichever of them is true.

    `about` are the simulations at every instant (P, N) and `gaps` what fits leave of training motion, both in units of
    the spread there, of which the band about a single simulation goes `factor` to either side.
    """
    gaps, low, high = np.sort(gaps), about.min(0), about.max(0)

    def held(share: float) -> float:
        below = np.searchsorted(gaps, high + share * factor - about, side="right")
        outside = np.searchsorted(gaps, low - share * factor - about, side="left")
        return float((below - outside).mean(1).min()) / len(gaps)

    return next((share for share in NARROWER.tolist() if held(share) >= SHARE), 1.0)


def _uncertainty(squares: Array) -> Array:
    """Factor on the spread, by one standard error of the mean square that G recordings leave (G, J), (J,)."""
    if len(squares) < 2:
        return np.ones(squares.shape[1])
    error = squares.std(axis=0, ddof=1) / np.sqrt(len(squares))
    return np.asarray(np.sqrt(1.0 + error / np.maximum(squares.mean(0), 1e-300)))


def _lasting(left: Array, weight: Array) -> Array:
    """Share of the variance of gaps (To, J, W) that the samples beside each tell: 0 for noise, (J,)."""
    bent, told = left[2:] - 2.0 * left[1:-1] + left[:-2], weight[2:] * weight[1:-1] * weight[:-2]
    noise = (bent**2 * told).sum((0, 2)) / 6.0 / np.maximum(told.sum((0, 2)), 1.0)
    variance = (left**2 * weight).sum((0, 2)) / np.maximum(weight.sum((0, 2)), 1.0)
    return np.asarray((1.0 - np.minimum(noise / np.maximum(variance, 1e-300), 1.0)) ** 2)


def _variance(search: LoopSearch, fit: LoopFit, spread: Covariance, data: Windows) -> Array:
    """Variance of the simulated positions by what is not known of the parameters, (To, J, W) [rad²].

    It is linear, so that parameters of which only ratios are known leave nothing open where they move nothing.
    """
    _, slopes = jacobian(replace(search, data=data), fit.point, spread.names)
    each = [np.einsum("atw,ab,btw->tw", x, spread.of_joint(j), x) for j, x in enumerate(slopes)]
    return np.stack(each, axis=1)
