"""Limits that no recording reaches: what the training motion leaves open of them.

A limit of the torque or of the command's speed that was never reached is not absent: it lies above what was asked for.
Its distribution is that of a prior, log-uniform from there up, weighted by what each level costs the fit of the
training motion; motion that asks for no more is as it was, and motion that asks for more is less sure.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, batch, evaluate, residuals, root_mean_squares
from sim_gap.position_gap.search import LoopSearch

HEADROOM = 10.0
"""Ratio of the highest level of the prior to the least that the training motion admits: recordings use between a tenth
and all of what a drive can do."""
LEVELS = np.geomspace(0.1, 100.0, 61)
"""Levels at which a limit is tried, in units of the joint's RMS torque or of the command's highest speed."""
FINER = np.geomspace(1.0, LEVELS[1] / LEVELS[0], 9)[1:-1]
"""Levels between two of those, over the lower one: where the least one is looked for."""
COSTS = 2.0
"""Loss of the score from which a level contradicts the training motion: 95 % of the likelihood of one parameter."""
LIMITS = {"limit": "actuator.saturation", "slew": "controller.slew"}
"""Parameter that is a limit → its effect."""


@dataclass(frozen=True, eq=False)
class Unreached:
    """A limit of one joint that the training motion does not show."""

    joint: int
    name: str
    levels: Array
    """Where it may lie, rising by a common factor (L,)."""
    weights: Array
    """Probability of each (L,)."""
    least: float
    """Lowest level that the training motion admits."""


def find_unreached(search: LoopSearch, fit: LoopFit, vague: Collection[tuple[int, str]] = ()) -> tuple[Unreached, ...]:
    """The limits that neither the model states nor the fit has, where some level of them is admitted; and of those that
    the fit has the `vague` ones (joint, name), where no level above it costs much. Nothing of joints that rest."""
    out: list[Unreached] = []
    for name, effect in LIMITS.items():
        open_at = np.isinf(fit.point[name]) & (effect not in search.excluded)
        open_at |= np.array([(j, name) in vague for j in range(search.data.joints)])
        open_at[list(search.resting)] = False
        if not open_at.any():
            continue
        levels = LEVELS[:, None] * search.size_of(name)
        lost = _losses(search, fit, name, levels)
        first = _first_admitted(lost)
        between = levels[np.maximum(first - 1, 0), np.arange(len(first))] * FINER[:, None]
        finer = _first_admitted(_losses(search, fit, name, between))
        for j in np.flatnonzero(open_at & (first < len(levels))).tolist():
            near = first[j] > 0 and finer[j] < len(FINER)
            least = between[finer[j], j] if near else levels[first[j], j]
            if least > fit.point[name][j]:
                continue
            taken = (np.arange(len(levels)) >= first[j]) & (levels[:, j] <= HEADROOM * least)
            weights = np.where(taken, np.exp(-np.clip(lost[:, j], -50.0, 50.0)), 0.0)
            out.append(Unreached(j, name, levels[:, j], weights / weights.sum(), float(least)))
    return tuple(out)


def _first_admitted(lost: Array) -> NDArray[np.intp]:
    """Index of the first level from which on none costs much, (J,); their number where the highest does."""
    costly = lost >= COSTS
    return np.where(costly.any(0), len(lost) - np.argmax(costly[::-1], axis=0), 0)


def _losses(search: LoopSearch, fit: LoopFit, name: str, levels: Array) -> Array:
    """Loss of each joint's score with a limit at each level, all else as it is, (L, J)."""
    left = residuals(search.data, batch([{**fit.point, name: level} for level in levels]))
    base = search.score(evaluate(search.data, fit))
    each = root_mean_squares(search.data, left)
    return np.stack([search.score(LoopFit(fit.point, fit.active, rms=rms)) - base for rms in each])


def draw_limits(limits: Sequence[Unreached], count: int, random: np.random.Generator) -> list[Array]:
    """Draws of each limit, (count,): levels by their weights, spread evenly over the factor between two."""
    out = []
    for each in limits:
        ratio = float(each.levels[1] / each.levels[0])
        at = random.choice(each.levels, size=count, p=each.weights)
        out.append(np.asarray(at * ratio ** random.uniform(-0.5, 0.5, count)))
    return out


def describe(limits: Sequence[Unreached], names: Sequence[str]) -> str:
    """The limits and their least values in words; nothing if there is none."""
    told = []
    for name, what, unit in (("limit", "torque", "N·m"), ("slew", "speed of the command", "rad/s")):
        if least := [f"{names[each.joint]} {each.least:.3g}" for each in limits if each.name == name]:
            told.append(f"{what} at least {', '.join(least)} {unit}")
    return "; ".join(told)
