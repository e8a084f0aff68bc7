"""Takes out effects that the data do not need, and says how doubtful those are that stay."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from gcomp.arrays import Array
from sim_gap.closed_loop.columns import shared_effects
from sim_gap.closed_loop.fit import LOGARITHMIC, Fit, improve, jacobian
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import (
    INDEPENDENT_S,
    PRICE,
    Group,
    Search,
    acts,
    effects_at,
    merged,
    only,
    price,
    taken_out,
    without,
)

DOUBTFUL = 4.0
"""Expected loss, in prices, up to which it is tried whether an effect is needed."""
CALM = 0.5
"""Share of a joint's RMS over all windows below which what is left of a window tells little."""
LEAST_FREEDOM = 2
"""Degrees of freedom that are counted at least: two recordings alone have one, whose 95 % are 13 standard errors."""
ROUNDS = 4


def pruned(search: Search, fit: Fit) -> Fit:
    """The fit without effects whose removal costs less than their price."""
    for _ in range(2):
        before, best, changed = search.score(fit), fit, False
        doubtful = _doubtful(search, fit)
        removable = [
            [e for e in effects_at(fit, j) if _removable(search, fit, e, j)] for j in range(search.data.joints)
        ]
        removable = [[e for e in each if (j, e) in doubtful] for j, each in enumerate(removable)]
        losses: list[list[tuple[float, str, Fit]]] = [[] for _ in removable]
        for j, effect, trial in _without_each(search, fit, removable):
            losses[j].append((float((search.score(trial) - before)[j]), effect, trial))
        for j, each in enumerate(losses):
            if each:
                loss, effect, trial = min(each, key=lambda item: item[0])
                if loss < price(search, len(EFFECTS[effect].parameters))[j]:
                    best, changed = merged(best, trial, j), True
        if not changed:
            break
        fit = improve(search.data, best, search.scales, 4)
    return fit


def _without_each(search: Search, fit: Fit, removable: list[list[str]]) -> Iterator[tuple[int, str, Fit]]:
    """Joint, effect and the fit without it, that joint fitted again; for every effect of each joint's list."""
    for rank in range(max((len(each) for each in removable), default=0)):
        tried = {j: each[rank] for j, each in enumerate(removable) if rank < len(each)}
        trial = fit
        for j, effect in tried.items():
            trial = without(search, trial, effect, j)
        kept = trial.active
        trial = replace(improve(search.data, only(trial, tried), search.scales, 3), active=kept, shared=fit.shared)
        for j, effect in tried.items():
            yield j, effect, trial


@dataclass(frozen=True, eq=False)
class Without:
    """A fit without one of its effects."""

    group: Group
    """The effect, of one joint or of the whole arm."""
    fit: Fit
    """Fitted again at that joint, or at all."""
    doubt: float
    """Probability that the effect pays in no more than some windows or recordings by chance."""


def typical(search: Search, fit: Fit, progress: Callable[[str], None]) -> tuple[Fit, list[Without]]:
    """The fit without effects that pay in a recording or two and not in the others, and what it would be without each
    effect that stays.

    The sum over all recordings is made up of those with the largest gap: an effect that takes up what the model lacks
    in one of them spoils the others.
    """
    for number in range(ROUNDS + 1):
        others = list(_doubted(search, fit))
        doubted = [each for each in others if each.doubt > 0.5]
        if not doubted or number == ROUNDS:
            break
        progress(f"{len(doubted)} effects that pay in some recordings alone")
        whole = [each for each in doubted if not each.group[1]]
        if whole:
            fit = max(whole, key=lambda each: each.doubt).fit
        for j in range(search.data.joints) if not whole else ():
            if own := [each for each in doubted if each.group[1] == (j,)]:
                fit = merged(fit, max(own, key=lambda each: each.doubt).fit, j)
        fit = improve(search.data, fit, search.scales, 4)
    return fit, others


def _doubted(search: Search, fit: Fit) -> Iterator[Without]:
    """The fit without each effect that may be taken out."""
    removable = [[e for e in effects_at(fit, j) if _removable(search, fit, e, j)] for j in range(search.data.joints)]
    for j, effect, other in _without_each(search, fit, removable):
        least = float(price(search, len(EFFECTS[effect].parameters))[j])
        yield Without((effect, (j,)), other, _doubt(search, fit, other, (j,), least))
    for effect, names in shared_effects(search.data.arm).items():
        if own := set(names) & set(fit.shared):
            other = improve(search.data, taken_out(search, fit, (effect, ())), search.scales, 4)
            every = range(search.data.joints)
            yield Without((effect, ()), other, _doubt(search, fit, other, every, PRICE * len(own)))


def _doubt(search: Search, fit: Fit, other: Fit, joints: Iterable[int], least: float) -> float:
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


def _doubtful(search: Search, fit: Fit) -> set[tuple[int, str]]:
    """Effects whose removal is expected to cost less than some times their price, from the slopes of the fit."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active)
    found = set[tuple[int, str]]()
    for j, own in enumerate(fit.active):
        flat = slopes[j].reshape(len(own), now[:, j].size)
        total = max(float((now[:, j] ** 2).sum()), 1e-300)
        spread = np.linalg.pinv(flat @ flat.T, rcond=1e-9, hermitian=True)
        for effect in effects_at(fit, j):
            names = EFFECTS[effect].parameters
            index = [own.index(name) for name in names if name != "stribeck_velocity"]
            away = np.array([_distance(search, fit, own[i], j) for i in index])
            if not np.all(np.isfinite(away)):
                found.add((j, effect))
                continue
            lost = float(away @ np.linalg.pinv(spread[np.ix_(index, index)]) @ away) / total
            fall = 0.5 * float(search.samples[j]) * float(np.log1p(max(lost, 0.0)))
            if fall < DOUBTFUL * price(search, len(names))[j]:
                found.add((j, effect))
    return found


def _distance(search: Search, fit: Fit, name: str, joint: int) -> float:
    """Distance of a parameter from the nominal one, in its own coordinate."""
    value, nominal = float(fit.point[name][joint]), float(search.nominal[name][joint])
    if name in LOGARITHMIC:
        return float(np.log(value / nominal)) if np.isfinite(nominal) and min(nominal, value) > 0.0 else float("inf")
    return (value - nominal) / float(search.scales.of(name)[joint])


def _removable(search: Search, fit: Fit, effect: str, joint: int) -> bool:
    needed = any(effect in EFFECTS[other].needs for other in effects_at(fit, joint))
    return effect not in search.kept and (not needed or acts(search.nominal, effect, joint))
