"""Which effects: forward selection at all joints at once, then removal of what is not needed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim_gap.closed_loop.choice.candidates import expected_shared, ranked
from sim_gap.closed_loop.choice.prune import pruned
from sim_gap.closed_loop.columns import shared_effects
from sim_gap.closed_loop.fit import Fit, evaluate, improve, jacobian
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import LEAST_FALL, PRICE, Search, merged, only, price, with_effect

TRIES = 2
"""Candidates per joint that are fitted in a round."""
ROUNDS = 6
Progress = Callable[[str], None]


def select(search: Search, fit: Fit, progress: Progress = lambda text: None) -> Fit:
    """Add effects while they pay, joint by joint and for the whole arm, then take out what is not needed."""
    own = [e for e in EFFECTS if e not in search.excluded]
    fit = improve(search.data, fit, search.scales)
    whole = {e: names for e, names in shared_effects(search.data.arm).items() if e.split("@")[0] not in search.excluded}
    open_joints = set(range(search.data.joints)) - search.resting
    for round_number in range(ROUNDS):
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
    return pruned(search, fit)


def select_about(search: Search, fit: Fit, progress: Progress = lambda text: None) -> Fit:
    """The better of two selections: from `fit`, whose gains and friction are free, and from the nominal model as it is.

    A free gain with damping takes the place of a delay, of a limit or of friction, which then are not looked for any
    more.
    """
    found = select(search, fit, progress)
    if search.open_controller:
        return found
    progress("from the model's own controller")
    own = {name: values.copy() for name, values in search.nominal.items()}
    other = select(replace(search, kept=frozenset()), Fit(own, ((),) * search.data.joints), progress)
    return _better(search, found, other)


def _better(search: Search, one: Fit, other: Fit) -> Fit:
    """Of two fits that with the lower score, each parameter at its price; joint by joint where nothing couples them."""
    scores = np.array([search.score(fit) + PRICE * np.array([len(own) for own in fit.active]) for fit in (one, other)])
    if one.shared or other.shared:
        whole = scores.sum(axis=1) + PRICE * np.array([len(one.shared), len(other.shared)])
        return one if whole[0] <= whole[1] else other
    for j in np.flatnonzero(scores[1] < scores[0]).tolist():
        one = merged(one, other, j)
    return evaluate(search.data, one)


def _own_round(
    search: Search, fit: Fit, candidates: list[list[tuple[float, str]]], open_joints: set[int]
) -> tuple[Fit, set[int]]:
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
                best, changed = merged(best, trial, j), changed | {j}
                best_score[j] = score[j]
    return (evaluate(search.data, best) if changed else fit), changed


def _restored(fit: Fit, tried: dict[int, str], joint: int) -> tuple[str, ...]:
    extra = EFFECTS[tried[joint]].parameters if joint in tried else ()
    return (*fit.active[joint], *extra)


def _shared_round(search: Search, fit: Fit, whole: dict[str, tuple[str, ...]], best_own: float) -> Fit | None:
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
