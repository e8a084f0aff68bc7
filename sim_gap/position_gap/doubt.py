"""How doubtful each effect of a fit is, and what the fit would be without it.

The score is a sum over all windows, made up of those with the largest gap: an effect that takes up what the model lacks
in one recording pays, and spoils the others. So what an effect lowers is compared from window to window and from
recording to recording. An effect of the whole arm, such as a payload, changes gain, friction and inertia of all joints
together; it is compared with what the joints' own effects make of it when they are chosen again without it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from gcomp.arrays import Array
from sim_gap.position_gap.columns import UNIT, shared_effects
from sim_gap.position_gap.fit import LoopFit, improve
from sim_gap.position_gap.parameters import EFFECTS, WITH_TORQUE
from sim_gap.position_gap.search import (
    INDEPENDENT_S,
    PRICE,
    Group,
    LoopSearch,
    effects_at,
    merge_joint,
    price,
    shared_of,
    size_of,
    start_of,
    without_group,
)
from sim_gap.position_gap.selection import Progress, removable_at, removals, select

PLAINEST = "plainest"
PLAIN = "friction.coulomb", "friction.viscous"
SCALE_SHARES = 0.7, 0.4
"""Scales at which a fit begins again, as shares of its own."""
ITERATIONS = 12


def plainest_fit(search: LoopSearch, fit: LoopFit) -> Iterator[LoopFit]:
    """The fit with these alone at each joint that has anything else; nothing if none has."""
    kept = [
        effect for effect in EFFECTS if effect in search.kept or (effect in PLAIN and effect not in search.excluded)
    ]
    names = tuple(name for effect in kept for name in EFFECTS[effect].parameters)
    more = [j for j in range(search.data.joints) if not {*fit.active[j]} <= {*names}]
    other = fit
    for effect in shared_of(fit, search):
        other = without_group(search, other, (effect, ()))
    for j in more:
        for effect in effects_at(fit, j):
            if effect not in kept:
                other = without_group(search, other, (effect, (j,)))
    if not more and not fit.shared:
        return
    point = {name: values.copy() for name, values in other.point.items()}
    for j in more:
        for name in names:
            if point[name][j] == 0.0:
                point[name][j] = start_of(search, name, j)
    active = tuple(names if j in more else own for j, own in enumerate(other.active))
    yield improve(search.data, replace(other, point=point, active=active, rms=None), search.scales, ITERATIONS)


ROTORS = "actuator.rotor_inertia"


def fits_at_other_scales(search: LoopSearch, fit: LoopFit) -> Iterator[LoopFit]:
    """The fit from each smaller scale, the rotors that the model states free; none if there are none to free."""
    if ROTORS in search.excluded:
        return
    stated = search.nominal["armature"] > 0.0
    free = [("kp" in own and bool(stated[j]) and "armature" not in own) for j, own in enumerate(fit.active)]
    if not any(free):
        return
    active = tuple((*own, "armature") if loose else own for own, loose in zip(fit.active, free, strict=True))
    for share in SCALE_SHARES:
        part = np.where(free, share, 1.0)
        point = {name: values * part if name in WITH_TORQUE else values.copy() for name, values in fit.point.items()}
        point |= {name: share * fit.point[name] for name in fit.shared if UNIT[name.partition(".")[2]] != "rad"}
        yield improve(search.data, replace(fit, point=point, active=active, rms=None), search.scales, ITERATIONS)


CALM = 0.5
"""Share of a joint's RMS over all windows below which what is left of a window tells little."""
LEAST_FREEDOM = 2
"""Degrees of freedom that are counted at least: two recordings alone have one, whose 95 % are 13 standard errors."""
ROUNDS = 4
"""Times that effects are taken out and the rest is fitted again, at most."""


@dataclass(frozen=True, eq=False)
class Other:
    """Another choice: without an effect that the fit has, or with one that was taken out."""

    group: Group
    """The effect, of one joint or of the whole arm."""
    fit: LoopFit
    """Fitted again at that joint, or at all."""
    likely: float
    """Probability that this is the right one of both."""


def settle(search: LoopSearch, fit: LoopFit, progress: Progress) -> tuple[LoopFit, list[Other]]:
    """The fit without effects that pay in a recording or two and not in the others, and the other choices."""
    dropped: list[Other] = []
    for _ in range(ROUNDS):
        others = list(_others(search, fit, progress))
        better = [each for each in others if each.likely > 0.5]
        if not better:
            return fit, [*others, *dropped]
        progress(f"{len(better)} effects that pay in some recordings alone")
        taken = _best_of(better)
        dropped += [replace(each, fit=fit, likely=1.0 - each.likely) for each in taken]
        for each in taken:
            fit = merge_joint(fit, each.fit, each.group[1][0]) if each.group[1] else each.fit
        fit = improve(search.data, fit, search.scales, 4)
    return fit, [each for each in _others(search, fit, progress) if each.likely <= 0.5] + dropped


def _best_of(others: list[Other]) -> list[Other]:
    """The likeliest of the whole arm; without any, of each joint."""
    whole = [each for each in others if not each.group[1]]
    groups = [whole] if whole else [[o for o in others if o.group[1] == at] for at in {o.group[1] for o in others}]
    return [max(each, key=lambda other: other.likely) for each in groups]


def _others(search: LoopSearch, fit: LoopFit, progress: Progress) -> Iterator[Other]:
    """The fit without each effect that may be taken out."""
    for j, effect, other in removals(search, fit, removable_at(search, fit)):
        least = float(price(search, len(EFFECTS[effect].parameters))[j])
        yield Other((effect, (j,)), other, _doubt(search, fit, other, (j,), least))
    own = replace(search, excluded=search.excluded | {e.partition("@")[0] for e in shared_effects(search.data.arm)})
    for effect in shared_of(fit, search):
        progress(f"without {effect}")
        other = improve(search.data, select(own, without_group(search, fit, (effect, ()))), search.scales, 4)
        more = PRICE * (size_of(fit) - size_of(other))
        yield Other((effect, ()), other, _doubt(search, fit, other, range(search.data.joints), more))
    for other in fits_at_other_scales(search, fit):
        yield from _of_each_joint(search, fit, other, ROTORS)
    for other in plainest_fit(search, fit):
        yield from _of_each_joint(search, fit, other, PLAINEST)


def _of_each_joint(search: LoopSearch, fit: LoopFit, other: LoopFit, called: str) -> Iterator[Other]:
    """Another fit with other effects, at each joint that it differs at; of all, if something couples them."""
    if fit.shared:
        more = PRICE * (size_of(fit) - size_of(other))
        yield Other((called, ()), other, _doubt(search, fit, other, range(search.data.joints), more))
        return
    for j, own in enumerate(other.active):
        if own != fit.active[j]:
            more = PRICE * (len(fit.active[j]) - len(own))
            yield Other((called, (j,)), merge_joint(fit, other, j), _doubt(search, fit, other, (j,), more))


def _doubt(search: LoopSearch, fit: LoopFit, other: LoopFit, joints: Iterable[int], least: float) -> float:
    """Probability that the score would not fall by `least` over many more windows, or recordings, like these."""
    assert fit.rms is not None
    assert other.rms is not None
    data, falls = search.data, np.zeros(search.data.count)
    for j in joints:
        count = data.weight.sum(0)[j]
        calm = search.floor[j] ** 2 + CALM**2 * float((fit.rms[j] ** 2 * count).sum() / max(float(count.sum()), 1.0))
        samples = count * data.stride * data.dt / INDEPENDENT_S
        falls += 0.5 * samples * np.log((other.rms[j] ** 2 + calm) / (fit.rms[j] ** 2 + calm))
    return max(_tail(falls, groups, least) for groups in (np.arange(data.count), data.recording))


def _tail(falls: Array, groups: NDArray[np.intp], least: float) -> float:
    """Probability by Student's distribution that the sum over so many groups is less; 0 for a single group."""
    sums = np.array([falls[groups == group].sum() for group in np.unique(groups)])
    if len(sums) < 2:
        return 0.0
    error = max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-9)
    return float(t.sf((float(sums.sum()) - least) / error, max(len(sums) - 1, LEAST_FREEDOM)))
