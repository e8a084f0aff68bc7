"""Limits that no recording reaches: what the training motion leaves open of them.

A limit of the torque or of the command's speed that was never reached is not absent: it lies above what was asked for.
Its distribution is that of a prior, log-uniform from there up; motion that asks for no more is as it was, and motion
that asks for more is less sure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.linear_terms import SIGNIFICANT
from sim_gap.position_gap.fit import LoopFit, LoopSearch, residuals

HEADROOM = 10.0
"""Ratio of the highest level of the prior to the least that the training motion admits: recordings use between a tenth
and all of what a drive can do."""
ABOVE = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Levels that are tried, over what the training motion asks for: commands are held from row to row, so that a limit of
their speed shows far above it."""
COSTS = 0.5 * SIGNIFICANT**2
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

    def draws(self, count: int, random: np.random.Generator) -> Array:
        """(count,)."""
        return np.asarray(self.least * HEADROOM ** random.uniform(size=count))


def find_unreached(search: LoopSearch, fit: LoopFit) -> tuple[Unreached, ...]:
    """The limits that neither the model states nor the fit has. Nothing of joints that rest."""
    out: list[Unreached] = []
    asked = {"limit": _torques(search, fit), "slew": _command_speeds(search)}
    for name, effect in LIMITS.items():
        admitted = _least_admitted(search, fit, name, asked[name])
        for j in range(search.data.joints):
            least = float(admitted[j])
            if np.isfinite(fit.point[name][j]) or effect in search.excluded or j in search.resting or least <= 0.0:
                continue
            out.append(Unreached(j, name, least))
    return tuple(out)


def _least_admitted(search: LoopSearch, fit: LoopFit, name: str, asked: Array) -> Array:
    """The least of some levels from which on none contradicts the training motion, by halving, (J,)."""
    levels = np.array(ABOVE)[:, None] * np.maximum(asked, 1e-9)
    joints = np.arange(len(asked))

    bare = search.score(fit.point)
    low, high = np.zeros(len(asked), int), np.full(len(asked), len(ABOVE) - 1)  # the highest is admitted in any case
    while np.any(low < high):
        middle = (low + high) // 2
        costly = search.score({**fit.point, name: levels[middle, joints]}) - bare >= COSTS
        low, high = np.where(costly & (low < high), middle + 1, low), np.where(costly, high, middle)
    return np.where(asked > 0.0, levels[low, joints], 0.0)


def _torques(search: LoopSearch, fit: LoopFit) -> Array:
    """Torque that each servo is asked for along the training motion, (J,) [N·m]."""
    data, point = search.data, fit.point
    error = data.error - residuals(data, [point])[0]
    kp, inner = (point[name][:, None] for name in ("kp", "kv"))
    damping = np.minimum(inner, point["viscous"][:, None]) + point["kd"][:, None]
    counted = data.weight * data.served > 0.0
    asked = np.where(counted, np.abs(kp * error * data.scale - damping * data.v), 0.0)
    return np.asarray(asked.max(axis=(0, 2)))


def _command_speeds(search: LoopSearch) -> Array:
    """Highest speed of each command along the training motion, (J,) [rad/s]."""
    out = np.zeros(search.data.joints)
    for k in np.unique(search.data.piece):
        piece = search.data.pieces[k]
        held = np.diff(piece.area, axis=0) / np.diff(piece.ends)[:, None]
        if len(held) > 1:
            speed = np.abs(np.diff(held, axis=0)) / np.diff(piece.ends[:-1])[:, None]
            out = np.maximum(out, speed.max(axis=0))
    return out


def describe(limits: Sequence[Unreached], names: Sequence[str]) -> str:
    """The limits and their least values in words; nothing if there is none."""
    told = []
    for name, what, unit in (("limit", "torque", "N·m"), ("slew", "speed of the command", "rad/s")):
        if least := [f"{names[each.joint]} {each.least:.3g}" for each in limits if each.name == name]:
            told.append(f"{what} at least {', '.join(least)} {unit}")
    return "; ".join(told)
