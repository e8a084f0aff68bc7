"""Bands of closed-loop motion: what parameters that are not known, and what no parameter explains, leave open.

The band of a joint at each instant joins the spread of simulations with draws of all parameters and the spread of what
the fit left of the training motion, scaled so that it holds its share of that; on other motion it is a forecast.
"""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.fit import Fit, batch, residuals, root_mean_squares
from sim_gap.closed_loop.judge import Covariance, draw, joint_rms
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.simulate import simulate
from sim_gap.closed_loop.windows import Windows

SHARE = 0.9
"""Share of the motion that a band should hold."""
DRAWS = 40
"""Simulations with drawn parameters."""


@dataclass(frozen=True, eq=False)
class Band:
    """Band about the corrected simulation, (J,) each."""

    holds: Array
    """Share of the held-out samples within it."""
    width: Array
    """RMS of half of it on held-out motion [rad]."""
    unexplained: Array
    """Standard deviation of what no parameter explains [rad]: noise to add to the draws."""


def band(search: Search, fit: Fit, spread: Covariance, heldout: Windows) -> Band:
    """The band that follows from the training windows of `search`, judged on the held-out ones."""
    data = search.data
    left = residuals(data, batch([fit.point]))
    free = data.count / max(data.count - max(len(own) for own in fit.active), 1.0)
    unexplained = joint_rms(data, root_mean_squares(data, left)[0]) * np.sqrt(free)
    points = drawn(search, fit, spread)
    size = np.sqrt(_variance(data, points) + unexplained[:, None] ** 2)
    factor = np.array([_quantile(left[0, :, j], size[:, j], data.weight[:, j]) for j in range(data.joints)])
    other = residuals(heldout, batch([fit.point]))[0]
    half = factor[:, None] * np.sqrt(_variance(heldout, points) + unexplained[:, None] ** 2)
    counts = np.maximum(heldout.weight.sum((0, 2)), 1.0)
    holds = ((np.abs(other) <= half) * heldout.weight).sum((0, 2)) / counts
    return Band(holds, np.sqrt((half**2 * heldout.weight).sum((0, 2)) / counts), unexplained)


def drawn(search: Search, fit: Fit, spread: Covariance, count: int = DRAWS) -> list[dict[str, Array]]:
    """Points with parameters drawn from their joint distribution."""
    places = {name: j for j, name in enumerate(search.data.arm.names)}
    out = []
    for row in draw(search, fit, spread, count):
        point = {name: values.copy() for name, values in fit.point.items()}
        for key, value in row.items():
            joint, _, name = key.rpartition(".")
            if key in fit.shared:
                point[key][:] = value
            else:
                point[name][places[joint]] = value
        out.append(point)
    return out


def _variance(data: Windows, points: list[dict[str, Array]]) -> Array:
    """Variance of the simulated positions over the points, (To, J, W) [rad²]."""
    return np.asarray(simulate(data, batch(points)).var(axis=0))


def _quantile(left: Array, size: Array, weight: Array) -> float:
    """Multiple of `size` within which the share SHARE of the samples lies."""
    return float(np.quantile((np.abs(left) / size)[weight > 0.0], SHARE))
