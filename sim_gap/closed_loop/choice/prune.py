"""Takes out effects that the data do not need."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sim_gap.closed_loop.coordinates import LOGARITHMIC
from sim_gap.closed_loop.fit import Fit, improve, jacobian
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import Search, acts, effects_at, merged, only, price, without

DOUBTFUL = 4.0
"""Expected loss, in prices, up to which it is tried whether an effect is needed."""


def pruned(search: Search, fit: Fit) -> Fit:
    """The fit without effects whose removal costs less than their price."""
    for _ in range(2):
        before, best, changed = search.score(fit), fit, False
        doubtful = _doubtful(search, fit)
        removable = [[e for e in each if (j, e) in doubtful] for j, each in enumerate(removable_at(search, fit))]
        losses: list[list[tuple[float, str, Fit]]] = [[] for _ in removable]
        for j, effect, trial in without_each(search, fit, removable):
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


def without_each(search: Search, fit: Fit, removable: list[list[str]]) -> Iterator[tuple[int, str, Fit]]:
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


def removable_at(search: Search, fit: Fit) -> list[list[str]]:
    """Effects of each joint that may be taken out."""
    return [[e for e in effects_at(fit, j) if _removable(search, fit, e, j)] for j in range(search.data.joints)]


def _removable(search: Search, fit: Fit, effect: str, joint: int) -> bool:
    needed = any(effect in EFFECTS[other].needs for other in effects_at(fit, joint))
    return effect not in search.kept and (not needed or acts(search.nominal, effect, joint))
