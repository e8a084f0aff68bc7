"""Which effects: forward selection at all joints at once, then removal of what is not needed.

What a fit of an effect would bring is expected from one simulation of each.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.columns import shared_effects
from sim_gap.position_gap.fit import LoopFit, batch, evaluate, improve, jacobian, residuals
from sim_gap.position_gap.parameters import EFFECTS, LOGARITHMIC, PARAMETERS
from sim_gap.position_gap.search import (
    LEAST_FALL,
    LEVELS,
    PRICE,
    LoopSearch,
    effect_there,
    effects_at,
    is_active,
    level_of,
    merge_joint,
    only,
    price,
    start_of,
    with_effect,
    without_effect,
)

DOUBTFUL = 4.0
"""Expected loss, in prices, up to which it is tried whether an effect is needed."""


def prune(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit without effects whose removal costs less than their price."""
    for _ in range(2):
        before, best, changed = search.score(fit), fit, False
        doubtful = _doubtful(search, fit)
        removable = [[e for e in each if (j, e) in doubtful] for j, each in enumerate(removable_at(search, fit))]
        losses: list[list[tuple[float, str, LoopFit]]] = [[] for _ in removable]
        for j, effect, trial in removals(search, fit, removable):
            losses[j].append((float((search.score(trial) - before)[j]), effect, trial))
        for j, each in enumerate(losses):
            if each:
                loss, effect, trial = min(each, key=lambda item: item[0])
                if loss < price(search, len(EFFECTS[effect].parameters))[j]:
                    best, changed = merge_joint(best, trial, j), True
        if not changed:
            break
        fit = improve(search.data, best, search.scales, 4)
    return fit


def removals(search: LoopSearch, fit: LoopFit, removable: list[list[str]]) -> Iterator[tuple[int, str, LoopFit]]:
    """Joint, effect and the fit without it, that joint fitted again; for every effect of each joint's list."""
    for rank in range(max((len(each) for each in removable), default=0)):
        tried = {j: each[rank] for j, each in enumerate(removable) if rank < len(each)}
        trial = fit
        for j, effect in tried.items():
            trial = without_effect(search, trial, effect, j)
        kept = trial.active
        trial = replace(improve(search.data, only(trial, tried), search.scales, 3), active=kept, shared=fit.shared)
        for j, effect in tried.items():
            yield j, effect, trial


def _doubtful(search: LoopSearch, fit: LoopFit) -> set[tuple[int, str]]:
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


def _distance(search: LoopSearch, fit: LoopFit, name: str, joint: int) -> float:
    """Distance of a parameter from the nominal one, in its own coordinate."""
    value, nominal = float(fit.point[name][joint]), float(search.nominal[name][joint])
    if name in LOGARITHMIC:
        return float(np.log(value / nominal)) if np.isfinite(nominal) and min(nominal, value) > 0.0 else float("inf")
    return (value - nominal) / float(search.scales.of(name)[joint])


def removable_at(search: LoopSearch, fit: LoopFit) -> list[list[str]]:
    """Effects of each joint that may be taken out."""
    return [[e for e in effects_at(fit, j) if _removable(search, fit, e, j)] for j in range(search.data.joints)]


def _removable(search: LoopSearch, fit: LoopFit, effect: str, joint: int) -> bool:
    needed = any(effect in EFFECTS[other].needs for other in effects_at(fit, joint))
    return effect not in search.kept and (not needed or is_active(search.nominal, effect, joint))


def ranked(search: LoopSearch, fit: LoopFit, own: Sequence[str]) -> list[list[tuple[float, str]]]:
    """Candidates of each joint with the expected fall of its score, best first."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, fit.shared)
    falls: list[list[tuple[float, str]]] = [[] for _ in range(search.data.joints)]
    changes = {effect: _change(search, fit, effect) for effect in own}
    points = [point for each in changes.values() for point in each]
    if not points:
        return falls
    answers = residuals(search.data, batch(points)) - now
    at = 0
    for effect, each in changes.items():
        columns = answers[at : at + len(each)]
        at += len(each)
        for j in range(search.data.joints):
            if effect_there(fit, effect, j) or not all(is_active(fit.point, need, j) for need in EFFECTS[effect].needs):
                continue
            share = _explained(now[:, j], slopes[j], columns[:, :, j], signed=_one_sided(fit, effect, j))
            expected = -0.5 * float(search.samples[j]) * np.log(max(1.0 - share, 1e-6))
            falls[j].append((expected - PRICE * len(each), effect))
    return [sorted(each, reverse=True) for each in falls]


def _one_sided(fit: LoopFit, effect: str, joint: int) -> bool:
    """Whether the effect's first parameter can only grow from where it is, or is a limit."""
    first = PARAMETERS[EFFECTS[effect].parameters[0]]
    return bool(fit.point[first.name][joint] <= first.low or np.isinf(first.neutral))


def _change(search: LoopSearch, fit: LoopFit, effect: str) -> list[dict[str, Array]]:
    """Points that differ from the fit by one parameter of the effect at every joint."""
    out = []
    for name in EFFECTS[effect].parameters:
        if name == "stribeck_velocity":
            continue
        point = dict(fit.point)
        start = np.array([start_of(search, name, j) for j in range(search.data.joints)])
        if name in LEVELS:
            point[name] = level_of(search, fit, name)
        elif name == "gain":
            point[name] = fit.point[name] * 1.05
        else:
            point[name] = fit.point[name] + start * (0.5 if PARAMETERS[name].low == PARAMETERS[name].neutral else 0.1)
        out.append(point)
    return out


def _explained(residual: Array, known: Array, columns: Array, signed: bool) -> float:
    """Share of a residual's square that columns explain beyond those that are fitted anyway."""
    r = residual.ravel()
    a, c = known.reshape(len(known), r.size), columns.reshape(len(columns), r.size)
    if len(a):
        inverse = np.linalg.pinv(a @ a.T, rcond=1e-8, hermitian=True)
        r = r - (r @ a.T) @ inverse @ a
        c = c - (c @ a.T) @ inverse @ a
    normal = c @ c.T
    if float(np.trace(normal)) <= 1e-18 * max(float(r @ r), 1e-300):
        return 0.0
    step = -np.linalg.pinv(normal, rcond=1e-8, hermitian=True) @ (c @ r)
    if signed and len(step) == 1 and step[0] < 0.0:
        return 0.0
    total = float(residual.ravel() @ residual.ravel())
    return float(step @ normal @ step) / max(total, 1e-300)


def expected_shared(
    search: LoopSearch, fit: LoopFit, now: Array, slopes: list[Array], columns: tuple[str, ...], names: tuple[str, ...]
) -> float:
    """Expected fall of the score by coefficients that all joints share."""
    total = len(names)
    normal, right, projected = np.zeros((total, total)), np.zeros(total), []
    for j, all_slopes in enumerate(slopes):
        own = len(fit.active[j]) + len(fit.shared)
        r = now[:, j].ravel()
        flat = all_slopes.reshape(len(all_slopes), r.size)
        a, c = flat[:own], flat[[own + columns.index(name) for name in names]]
        if len(a):
            inverse = np.linalg.pinv(a @ a.T, rcond=1e-8, hermitian=True)
            r, c = r - (r @ a.T) @ inverse @ a, c - (c @ a.T) @ inverse @ a
        weight = search.samples[j] / max(float(now[:, j].ravel() @ now[:, j].ravel()), 1e-300)
        normal += weight * c @ c.T
        right -= weight * (c @ r)
        projected.append((r, c))
    step = np.linalg.pinv(normal, rcond=1e-8, hermitian=True) @ right
    fall = 0.0
    for j, (r, c) in enumerate(projected):
        after = r + step @ c
        ratio = max(float(after @ after), 1e-300) / max(float(r @ r), 1e-300)
        fall -= 0.5 * float(search.samples[j]) * float(np.log(ratio))
    return fall - PRICE * total


TRIES = 2
"""Candidates per joint that are fitted in a round."""
Progress = Callable[[str], None]


def select(search: LoopSearch, fit: LoopFit, progress: Progress = lambda text: None) -> LoopFit:
    """Add effects while they pay, joint by joint and for the whole arm, then take out what is not needed."""
    own = [e for e in EFFECTS if e not in search.excluded]
    fit = improve(search.data, fit, search.scales)
    whole = {e: names for e, names in shared_effects(search.data.arm).items() if e.split("@")[0] not in search.excluded}
    open_joints = set(range(search.data.joints)) - search.resting
    for round_number in range(6):
        progress(f"round {round_number + 1}: {sum(len(each) for each in fit.active) + len(fit.shared)} parameters")
        candidates = ranked(search, fit, own)
        best_own = max((each[0][0] for j, each in enumerate(candidates) if each and j in open_joints), default=0.0)
        if shared := _shared_round(search, fit, whole, best_own):
            fit = shared
            open_joints = set(range(search.data.joints)) - search.resting
            continue
        fit, changed = _own_round(search, fit, candidates, open_joints)
        open_joints &= changed
        if not open_joints:
            break
    return prune(search, fit)


def select_about(search: LoopSearch, fit: LoopFit, progress: Progress = lambda text: None) -> LoopFit:
    """The better of two selections: from `fit`, whose gains and friction are free, and from the nominal model as it is.

    A free gain with damping takes the place of a delay, of a limit or of friction, which then are not looked for any
    more.
    """
    found = select(search, fit, progress)
    if search.open_controller:
        return found
    progress("from the model's own controller")
    own = {name: values.copy() for name, values in search.nominal.items()}
    other = select(replace(search, kept=frozenset()), LoopFit(own, ((),) * search.data.joints), progress)
    return _better(search, found, other)


def _better(search: LoopSearch, one: LoopFit, other: LoopFit) -> LoopFit:
    """Of two fits that with the lower score, each parameter at its price; joint by joint where nothing couples them."""
    scores = np.array([search.score(fit) + PRICE * np.array([len(own) for own in fit.active]) for fit in (one, other)])
    if one.shared or other.shared:
        whole = scores.sum(axis=1) + PRICE * np.array([len(one.shared), len(other.shared)])
        return one if whole[0] <= whole[1] else other
    for j in np.flatnonzero(scores[1] < scores[0]).tolist():
        one = merge_joint(one, other, j)
    return evaluate(search.data, one)


def _own_round(
    search: LoopSearch, fit: LoopFit, candidates: list[list[tuple[float, str]]], open_joints: set[int]
) -> tuple[LoopFit, set[int]]:
    """Fit the best candidates of every joint and keep the best where it pays."""
    before = search.score(fit)
    best, best_score, changed = fit, before.copy(), set[int]()
    for rank in range(TRIES):
        trial, tried = fit, {}
        for j in open_joints:
            if rank < len(candidates[j]) and candidates[j][rank][0] > 0.0:
                tried[j] = candidates[j][rank][1]
                trial = with_effect(search, trial, tried[j], j)
        if not tried:
            break
        trial = improve(search.data, only(trial, tried), search.scales, 4)
        trial = replace(trial, active=tuple(_restored(fit, tried, j) for j in range(search.data.joints)))
        score = search.score(trial)
        for j, effect in tried.items():
            fall = before[j] - score[j]
            if fall > price(search, len(EFFECTS[effect].parameters))[j] and score[j] < best_score[j]:
                best, changed = merge_joint(best, trial, j), changed | {j}
                best_score[j] = score[j]
    return (evaluate(search.data, best) if changed else fit), changed


def _restored(fit: LoopFit, tried: dict[int, str], joint: int) -> tuple[str, ...]:
    extra = EFFECTS[tried[joint]].parameters if joint in tried else ()
    return (*fit.active[joint], *extra)


def _shared_round(
    search: LoopSearch, fit: LoopFit, whole: dict[str, tuple[str, ...]], best_own: float
) -> LoopFit | None:
    """The fit with the best effect of the whole arm, if that pays and no joint's own effect is better."""
    there = {effect: tuple(n for n in names if n in search.data.columns) for effect, names in whole.items()}
    there = {effect: names for effect, names in there.items() if names and names[0] not in fit.shared}
    columns = tuple(dict.fromkeys(name for names in there.values() for name in names))
    if not columns:
        return None
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, (*fit.shared, *columns))
    expected = {effect: expected_shared(search, fit, now, slopes, columns, names) for effect, names in there.items()}
    effect = max(expected, key=lambda each: expected[each])
    names = there[effect]
    if expected[effect] < max(best_own, PRICE * len(names)):
        return None
    point = {**fit.point, **{name: np.zeros(search.data.joints) for name in names}}
    before = search.score(fit)
    trial = improve(search.data, replace(fit, point=point, shared=(*fit.shared, *names)), search.scales, 5)
    fall = before - search.score(trial)
    if fall.sum() < PRICE * len(names) or (fall < LEAST_FALL * np.maximum(search.samples, 1.0)).all():
        return None
    at_an_end = any(float(trial.point[name][0]) in search.data.ranges[name] for name in names)
    return None if at_an_end else trial
