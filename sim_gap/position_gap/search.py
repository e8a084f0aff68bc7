"""An effect put into a fit or taken out of it, and the windows as a search of effects counts them.

A joint that swings free goes astray by tenths of a radian where one that is held is off by milliradians: of both
together a sum of squares shows the swing alone. So both kinds of windows count as much (`balance`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.position_gap.columns import shared_effects
from sim_gap.position_gap.fit import LoopFit, batch, evaluate, residuals
from sim_gap.position_gap.parameters import EFFECTS, PARAMETERS, Scales
from sim_gap.position_gap.windows import Windows

INDEPENDENT_S = 0.5
"""Time over which residuals are correlated [s]."""
PRICE = 4.0
"""Fall of the score that a parameter has to pay for."""
LEVELS = {
    "slew": (0.2, 0.35, 0.5, 0.65, 0.8, 0.9),
    "limit": (0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0),
    "ki": (0.15, 0.6, 2.4),
}
"""Levels at which a limit or an integral part is tried: in units of the command's highest speed, of the joint's own
torque, of the gain per second."""
BETWEEN = 6
"""Levels that are tried between those beside the best."""
LEAST_FALL = 0.025
"""Least relative fall of a joint's RMS by an effect."""
Group = tuple[str, tuple[int, ...]]
"""An effect with the joints that have it; no joints for one of the whole arm."""


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """Data and nominal parameters of a competition of effects."""

    data: Windows
    scales: Scales
    nominal: dict[str, Array]
    """Parameters of the nominal model, to which one returns that is taken out, (J,) each."""
    floor: Array
    """RMS below which nothing can be seen, per joint (J,) [rad]."""
    excluded: frozenset[str] = frozenset()
    """Effects that do not take part."""
    kept: frozenset[str] = frozenset({"controller.stiffness"})
    """Effects that are not taken out."""
    resting: frozenset[int] = frozenset()
    """Joints of which nothing is fitted."""
    open_controller: bool = False
    """Whether the nominal model has no controller, so that the fitted one is no cause of a gap."""

    def score(self, fit: LoopFit) -> Array:
        """Half the logarithm of the mean square, times independent samples, per joint (J,); less is better."""
        assert fit.rms is not None
        count = self.data.weight.sum(0)
        mean = (fit.rms**2 * count).sum(1) / np.maximum(count.sum(1), 1.0)
        return np.asarray(0.5 * self.samples * np.log(mean + self.floor**2))

    def size_of(self, name: str) -> Array:
        """Unit of the levels of a limit, (J,): the command's highest speed, if it moves at all, or the usual size."""
        if name != "slew":
            return self.scales.of(name)
        return np.asarray(np.maximum(np.abs(self.data.speed).max(axis=(0, 2)), PARAMETERS["slew"].low))

    @property
    def samples(self) -> Array:
        """Independent samples of each joint, (J,)."""
        judged = (self.data.weight > 0.0).sum((0, 2)) * self.data.stride * self.data.dt
        return np.asarray(judged / INDEPENDENT_S)


def size_of(fit: LoopFit) -> int:
    return sum(len(own) for own in fit.active) + len(fit.shared)


def price(search: LoopSearch, count: int) -> Array:
    """Least fall of the score for `count` more parameters, per joint (J,)."""
    return np.asarray(np.maximum(PRICE * count, search.samples * LEAST_FALL))


def with_effect(search: LoopSearch, fit: LoopFit, effect: str, joint: int) -> LoopFit:
    """The fit with an effect at one joint, at the size at which it is tried."""
    names = EFFECTS[effect].parameters
    active = list(fit.active)
    active[joint] = (*active[joint], *names)
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in names:
        neutral = point[name][joint] == PARAMETERS[name].neutral
        if name in LEVELS and (neutral or np.isinf(PARAMETERS[name].neutral)):
            point[name][joint] = level_of(search, fit, name)[joint]
        elif neutral:
            point[name][joint] = start_of(search, name, joint)
    return replace(fit, active=tuple(active), point=point, rms=None)


def level_of(search: LoopSearch, fit: LoopFit, name: str) -> Array:
    """The best of some levels of a limit or an integral part at every joint, (J,): a limit that is never reached has no
    slope to follow, and one that is always reached leads nowhere; an integral part that is next to none holds the
    torque at the start and does nothing else.

    Others between the best and those beside it are tried after: a joint that a limit lets stray from its course strays
    elsewhere with a level some tenths off.
    """
    if name == "ki":
        size, most = fit.point["kp"], np.full(search.data.joints, np.inf)
    else:
        size = search.size_of(name)
        most = fit.point[name]
    own = np.array(LEVELS[name])
    levels = np.minimum(np.array([own[0] ** 2 / own[1], *own, own[-1] ** 2 / own[-2]])[:, None] * size, most)
    best, joints = 1 + _best_level(search, fit, name, levels[1:-1]), np.arange(search.data.joints)
    below, above = (levels[best + step, joints] for step in (-1, 1))
    between = np.vstack([levels[best, joints], np.geomspace(below, above, BETWEEN + 2)[1:-1]])
    return np.asarray(between[_best_level(search, fit, name, between), joints])


def _best_level(search: LoopSearch, fit: LoopFit, name: str, levels: Array) -> NDArray[np.intp]:
    """Number of the level of a parameter, of (L, J), that leaves least at each joint, (J,)."""
    gaps = residuals(search.data, batch([{**fit.point, name: level} for level in levels]))
    return np.asarray(np.einsum("ptjw,ptjw->pj", gaps, gaps).argmin(axis=0))


def start_of(search: LoopSearch, name: str, joint: int) -> float:
    """Value at which a parameter that is no limit enters a fit."""
    if name in ("stribeck_velocity", "gain"):
        return PARAMETERS[name].neutral
    return float(np.clip(search.scales.of(name)[joint], PARAMETERS[name].low, PARAMETERS[name].high))


def without_effect(search: LoopSearch, fit: LoopFit, effect: str, joint: int) -> LoopFit:
    """The fit without an effect at one joint: its parameters are those of the nominal model."""
    names = EFFECTS[effect].parameters
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in names:
        point[name][joint] = search.nominal[name][joint]
    active = list(fit.active)
    active[joint] = tuple(name for name in active[joint] if name not in names)
    return replace(fit, point=point, active=tuple(active), rms=None)


def without_group(search: LoopSearch, fit: LoopFit, group: Group) -> LoopFit:
    effect, joints = group
    if not joints:
        names = set(shared_effects(search.data.arm)[effect])
        point = {name: 0.0 * x if name in names else x for name, x in fit.point.items()}
        return replace(fit, point=point, shared=tuple(n for n in fit.shared if n not in names), rms=None)
    for j in joints:
        fit = without_effect(search, fit, effect, j)
    return fit


def effect_there(fit: LoopFit, effect: str, joint: int) -> bool:
    return EFFECTS[effect].parameters[0] in fit.active[joint]


def is_active(point: Mapping[str, Array], effect: str, joint: int) -> bool:
    """Whether an effect changes the motion of a joint, fitted or not: its first parameter is not neutral."""
    first = EFFECTS[effect].parameters[0]
    return bool(point[first][joint] != PARAMETERS[first].neutral)


def effects_at(fit: LoopFit, joint: int) -> list[str]:
    return [effect for effect in EFFECTS if effect_there(fit, effect, joint)]


def shared_of(fit: LoopFit, search: LoopSearch) -> list[str]:
    return [e for e, names in shared_effects(search.data.arm).items() if set(names) & set(fit.shared)]


def only(fit: LoopFit, tried: dict[int, str]) -> LoopFit:
    """The fit with the parameters of other joints held."""
    return replace(fit, active=tuple(own if j in tried else () for j, own in enumerate(fit.active)), shared=())


def merge_joint(fit: LoopFit, other: LoopFit, joint: int) -> LoopFit:
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in point:
        point[name][joint] = other.point[name][joint]
    active = list(fit.active)
    active[joint] = other.active[joint]
    return replace(fit, point=point, active=tuple(active), rms=None)


LEAST_COUNT = 0.02
"""Least weight of a window, over one of the other kind."""


def weigh_kinds(search: LoopSearch, data: Windows, fit: LoopFit | None = None) -> Windows:
    """The windows as a search counts them: both kinds as much, and nothing of joints that rest, of which any friction
    holds the place."""
    data = balance(data, fit)
    if not search.resting:
        return data
    moves = [j not in search.resting for j in range(data.joints)]
    return replace(data, weight=data.weight * np.array(moves, float)[:, None])


def balance(data: Windows, fit: LoopFit | None = None) -> Windows:
    """The windows, with each in which a joint's servo is mostly off counted less, such that both kinds leave as much.

    What they leave is what the fit leaves of them; without a fit, the way to the command, and the motion while there is
    none. Where a servo is never off, or always, nothing changes.
    """
    off = data.served.mean(0) < 0.5
    if not off.any():
        return data
    if fit is None:
        way = np.where(data.served > 0.5, data.command - data.recorded, data.recorded - data.recorded.mean(0))
        squares = np.mean(way**2, axis=0)
    else:
        left = evaluate(data, fit).rms
        assert left is not None
        squares = left**2
    count = data.weight.sum(0)
    on_mean, off_mean = (
        (squares * count * kind).sum(1) / np.maximum((count * kind).sum(1), 1e-300) for kind in (~off, off)
    )
    share = np.sqrt(on_mean / np.maximum(off_mean, 1e-300))
    share = np.where((on_mean > 0.0) & (off_mean > 0.0), np.clip(share, LEAST_COUNT, 1.0), 1.0)
    return replace(data, weight=data.weight * np.where(off, share[:, None], 1.0))
