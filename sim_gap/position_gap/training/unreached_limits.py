"""Limits that no recording reaches: what the training motion leaves open of them.

A limit of the torque or of the command's speed that was never reached is not absent: it lies above what was asked for.
Its distribution is that of a prior, log-uniform from there up; motion that asks for no more is as it was, and motion
that asks for more is less sure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, LoopSearch, Point, joint_rms, residuals

HEADROOM = 10.0
"""Ratio of the highest level of the prior to the least that the training motion admits: recordings use between a tenth
and all of what a drive can do."""
ABOVE = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Levels that are tried, over what the training motion asks for: commands are held from row to row, so that a limit of
their speed shows far above it."""
COSTS = 2.0
"""Loss of the score from which a level contradicts the training motion: 95 % of the likelihood of one parameter."""
LIMITS = {"limit": "actuator.saturation", "slew": "controller.slew"}
"""Parameter that is a limit → its effect."""


@dataclass(frozen=True, eq=False)
class Unreached:
    """A limit of one joint that the training motion does not show."""

    joint: int
    name: str
    least: float
    """Lowest level that the training motion admits."""

    @property
    def most(self) -> float:
        return HEADROOM * self.least


def find_unreached(search: LoopSearch, fit: LoopFit) -> tuple[Unreached, ...]:
    """The limits that neither the model states nor the fit has. Nothing of joints that rest."""
    out: list[Unreached] = []
    for name, effect in LIMITS.items():
        open_at = ~np.isfinite(fit.point[name]) & ~np.isin(np.arange(search.data.joints), sorted(search.resting))
        if effect in search.excluded or not open_at.any():
            continue
        least = _least_admitted(search, fit, name, _torques(search, fit) if name == "limit" else _speeds(search))
        out += [Unreached(j, name, float(least[j])) for j in np.flatnonzero(open_at & (least > 0.0)).tolist()]
    return tuple(out)


def _least_admitted(search: LoopSearch, fit: LoopFit, name: str, asked: Array) -> Array:
    """The least of some levels from which on none contradicts the training motion, by halving, (J,)."""
    levels = np.array(ABOVE)[:, None] * np.maximum(asked, 1e-9)
    joints = np.arange(len(asked))

    def score(point: Point) -> Array:
        left = joint_rms(search.data, residuals(search.data, [point])[0])
        return np.asarray(search.samples * np.log(np.hypot(left, search.floor)))

    bare = score(fit.point)
    low, high = np.zeros(len(asked), int), np.full(len(asked), len(ABOVE) - 1)  # the highest is admitted in any case
    while np.any(low < high):
        middle = (low + high) // 2
        costly = score({**fit.point, name: np.minimum(levels[middle, joints], fit.point[name])}) - bare >= COSTS
        low, high = np.where(costly & (low < high), middle + 1, low), np.where(costly, high, middle)
    return np.where(asked > 0.0, levels[low, joints], 0.0)


def _torques(search: LoopSearch, fit: LoopFit) -> Array:
    """Torque that each servo is asked for along the training motion, (J,) [N·m]."""
    data, point = search.data, fit.point
    error = data.error - residuals(data, [point])[0]
    kp, inner = (point[name][:, None] for name in ("kp", "kv"))
    damping = np.minimum(inner, point["viscous"][:, None]) + point["kd"][:, None]
    pulls = np.abs(kp * error * data.scale - damping * data.v) * (data.weight * data.served > 0.0)
    return np.asarray(pulls.max((0, 2)))


def _speeds(search: LoopSearch) -> Array:
    """Highest speed of each command along the training motion, (J,) [rad/s]."""
    out = np.zeros(search.data.joints)
    for k in np.unique(search.data.piece):
        piece = search.data.pieces[k]
        held = np.diff(piece.area, axis=0) / np.diff(piece.ends)[:, None]
        if len(held) > 1:
            speed = np.abs(np.diff(held, axis=0)) / np.diff(piece.ends[:-1])[:, None]
            out = np.maximum(out, speed.max(axis=0))
    return out


def draw_limits(limits: Sequence[Unreached], count: int, random: np.random.Generator) -> list[Array]:
    """Draws of each limit from its prior, (count,)."""
    return [each.least * HEADROOM ** random.uniform(0.0, 1.0, count) for each in limits]


def describe(limits: Sequence[Unreached], names: Sequence[str]) -> str:
    """The limits and their least values in words; nothing if there is none."""
    told = []
    for name, what, unit in (("limit", "torque", "N·m"), ("slew", "speed of the command", "rad/s")):
        if least := [f"{names[each.joint]} {each.least:.3g}" for each in limits if each.name == name]:
            told.append(f"{what} at least {', '.join(least)} {unit}")
    return "; ".join(told)
