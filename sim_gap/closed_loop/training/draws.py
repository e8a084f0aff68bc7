"""Draws of the parameters from what recordings leave open of them."""

from collections.abc import Mapping

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.fit import Fit, moved
from sim_gap.closed_loop.search import Search, merged
from sim_gap.closed_loop.training.alternatives import Alternative
from sim_gap.closed_loop.training.limits import LIMITS, draw_limits
from sim_gap.closed_loop.training.spread import SCALED, Covariance


def draw(search: Search, fit: Fit, spread: Covariance, count: int, seed: int = 0) -> list[dict[str, float]]:
    """Draws of all parameters from their joint distribution, within their bounds, and of the limits that no recording
    reaches: `joint.name` → value. An effect that is in doubt is absent from its share of them."""
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(spread.matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = random.standard_normal((count, len(values))) @ root.T
    about = _points(fit, spread, count, random)
    rows = [_sample(search, fit, point, spread, row) for point, row in zip(about, steps, strict=True)]
    for each, drawn in zip(spread.limits, draw_limits(spread.limits, count, random), strict=True):
        for row, value in zip(rows, drawn, strict=True):
            row[f"{search.data.arm.names[each.joint]}.{each.name}"] = float(value)
    return rows


def _points(fit: Fit, spread: Covariance, count: int, random: np.random.Generator) -> list[Fit]:
    """The fit that each draw is about: for the whole arm or at each joint by itself, as likely as it is."""
    there = [other for other in spread.others if _told(fit, other)]
    out = []
    for _ in range(count):
        chosen = _chosen([other for other in there if other.joint < 0], random)
        point = fit if chosen is None else chosen.fit
        for j in range(len(fit.active)) if chosen is None else ():
            if (own := _chosen([other for other in there if other.joint == j], random)) is not None:
                point = merged(point, own.fit, j)
        out.append(point)
    return out


def _told(fit: Fit, other: Alternative) -> bool:
    """Whether a draw about another fit has a number for all that it has: no effect that the fit lacks, and a limit
    where the fit has one."""
    joints = range(len(fit.active)) if other.joint < 0 else (other.joint,)
    more = set(other.fit.shared) - set(fit.shared) or any(set(other.fit.active[j]) - set(fit.active[j]) for j in joints)
    return not more and all(
        np.isfinite(other.fit.point[name][j]) == np.isfinite(fit.point[name][j]) for name in LIMITS for j in joints
    )


def _chosen(others: list[Alternative], random: np.random.Generator) -> Alternative | None:
    """One of several fits by their odds; None is the fit itself."""
    ends = np.cumsum([1.0, *(other.odds for other in others)])
    at = int(np.searchsorted(ends, ends[-1] * random.random(), side="right"))
    return others[at - 1] if at else None


def _sample(search: Search, fit: Fit, about: Fit, spread: Covariance, steps: Array) -> dict[str, float]:
    """Parameters after `steps` from where the fit `about` has them; those that it lacks are as it has them."""
    out: dict[str, float] = {}
    labels: Mapping[int, str] = dict(enumerate(search.data.arm.names))
    deviations = np.sqrt(np.diag(spread.matrix))
    for (joint, name), step, deviation in zip(spread.names, steps.tolist(), deviations.tolist(), strict=True):
        if joint < 0:
            there = name in about.shared
            out[name] = float(np.clip(about.point[name][0] + step * there, *search.data.ranges[name]))
            continue
        value, size = float(about.point[name][joint]), float(search.scales.of(name)[joint])
        if name in fit.active[joint] and name not in about.active[joint]:
            out[f"{labels[joint]}.{name}"] = value
            continue
        if name in SCALED and deviation * size < value:  # such that the ratio to a gain, drawn with it, stays
            out[f"{labels[joint]}.{name}"] = value * float(np.exp(step * size / value))
        else:
            out[f"{labels[joint]}.{name}"] = moved(name, value, step, search.scales, joint)
    return out
