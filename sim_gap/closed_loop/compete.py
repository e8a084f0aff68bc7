"""Which controller and which effects: forward selection at all joints at once, then removal of what is not needed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.columns import shared_effects
from sim_gap.closed_loop.fit import Fit, batch, evaluate, improve, jacobian, residuals
from sim_gap.closed_loop.parameters import EFFECTS, PARAMETERS, Scales
from sim_gap.closed_loop.windows import WINDOW_S, Windows

INDEPENDENT_S = 0.5
"""Time over which residuals are correlated [s]."""
PRICE = 4.0
"""Fall of the score that a parameter has to pay for."""
LEAST_FALL = 0.025
"""Least relative fall of a joint's RMS by an effect."""
TRIES = 2
"""Candidates per joint that are fitted in a round."""
ROUNDS = 6
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Search:
    """What the competition works on."""

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

    def score(self, fit: Fit) -> Array:
        """Half the logarithm of the mean square, times independent samples, per joint (J,); less is better."""
        assert fit.rms is not None
        count = self.data.weight.sum(0)
        mean = (fit.rms**2 * count).sum(1) / np.maximum(count.sum(1), 1.0)
        return np.asarray(0.5 * self.samples * np.log(mean + self.floor**2))

    @property
    def samples(self) -> Array:
        """Independent samples of each joint, (J,)."""
        judged = self.data.weight.sum(0).sum(1) * self.data.stride * self.data.dt
        return np.asarray(judged / INDEPENDENT_S)


def price(search: Search, count: int) -> Array:
    """Least fall of the score for `count` more parameters, per joint (J,)."""
    return np.asarray(np.maximum(PRICE * count, search.samples * LEAST_FALL))


def with_effect(search: Search, fit: Fit, effect: str, joint: int) -> Fit:
    """The fit with an effect at one joint, at the size at which it is tried."""
    names = EFFECTS[effect].parameters
    active = list(fit.active)
    active[joint] = (*active[joint], *names)
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in names:
        if not np.isfinite(point[name][joint]) or point[name][joint] == PARAMETERS[name].neutral:
            point[name][joint] = start_of(search, name, joint)
    return replace(fit, active=tuple(active), point=point, rms=None)


def start_of(search: Search, name: str, joint: int) -> float:
    """Value at which a parameter enters a fit."""
    if name == "slew":
        return 0.8 * float(np.abs(search.data.speed[:, joint]).max())
    if name in ("stribeck_velocity", "gain"):
        return PARAMETERS[name].neutral
    return float(np.clip(search.scales.of(name)[joint], PARAMETERS[name].low, PARAMETERS[name].high))


def ranked(search: Search, fit: Fit, own: Sequence[str]) -> list[list[tuple[float, str]]]:
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
            if effect_there(fit, effect, j) or any(not effect_there(fit, need, j) for need in EFFECTS[effect].needs):
                continue
            share = _explained(now[:, j], slopes[j], columns[:, :, j], signed=_one_sided(effect))
            expected = -0.5 * float(search.samples[j]) * np.log(max(1.0 - share, 1e-6))
            falls[j].append((expected - PRICE * len(each), effect))
    return [sorted(each, reverse=True) for each in falls]


def effect_there(fit: Fit, effect: str, joint: int) -> bool:
    """Whether a joint has an effect among its fitted parameters."""
    return EFFECTS[effect].parameters[0] in fit.active[joint]


def _one_sided(effect: str) -> bool:
    first = PARAMETERS[EFFECTS[effect].parameters[0]]
    return bool(first.low == first.neutral or np.isinf(first.neutral))


def _change(search: Search, fit: Fit, effect: str) -> list[dict[str, Array]]:
    """Points that differ from the fit by one parameter of the effect at every joint."""
    out = []
    for name in EFFECTS[effect].parameters:
        if name == "stribeck_velocity":
            continue
        point = dict(fit.point)
        start = np.array([start_of(search, name, j) for j in range(search.data.joints)])
        if np.isinf(PARAMETERS[name].neutral):
            point[name] = np.minimum(fit.point[name], start)
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


def select(search: Search, fit: Fit, progress: Progress = lambda text: None) -> Fit:
    """Add effects while they pay, joint by joint and for the whole arm, then take out what is not needed."""
    own = [e for e in EFFECTS if e not in search.excluded and e != "transmission.ripple"]
    fit = improve(search.data, fit, search.scales)
    whole = {e: names for e, names in shared_effects(search.data.arm).items() if e.split("@")[0] not in search.excluded}
    open_joints = set(range(search.data.joints))
    for round_number in range(ROUNDS):
        progress(f"round {round_number + 1}: {sum(len(each) for each in fit.active) + len(fit.shared)} parameters")
        candidates = ranked(search, fit, own)
        best_own = max((each[0][0] for j, each in enumerate(candidates) if each and j in open_joints), default=0.0)
        if shared := _shared_round(search, fit, whole, best_own):
            fit = shared
            open_joints = set(range(search.data.joints))
            continue
        fit, changed = _own_round(search, fit, candidates, open_joints)
        open_joints &= changed
        if not open_joints:
            break
    return pruned(search, fit)


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
        trial = improve(search.data, _only(trial, tried), search.scales, 4)
        trial = replace(trial, active=tuple(_restored(fit, tried, j) for j in range(search.data.joints)))
        score = search.score(trial)
        for j, effect in tried.items():
            fall = before[j] - score[j]
            if fall > price(search, len(EFFECTS[effect].parameters))[j] and score[j] < best_score[j]:
                best, changed = _merged(best, trial, j), changed | {j}
                best_score[j] = score[j]
    return (evaluate(search.data, best) if changed else fit), changed


def _only(fit: Fit, tried: dict[int, str]) -> Fit:
    """The fit with the parameters of other joints held."""
    return replace(fit, active=tuple(own if j in tried else () for j, own in enumerate(fit.active)), shared=())


def _restored(fit: Fit, tried: dict[int, str], joint: int) -> tuple[str, ...]:
    extra = EFFECTS[tried[joint]].parameters if joint in tried else ()
    return (*fit.active[joint], *extra)


def _merged(fit: Fit, other: Fit, joint: int) -> Fit:
    """The fit with one joint's parameters from another."""
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in point:
        point[name][joint] = other.point[name][joint]
    active = list(fit.active)
    active[joint] = other.active[joint]
    return replace(fit, point=point, active=tuple(active), rms=None)


def _shared_round(search: Search, fit: Fit, whole: dict[str, tuple[str, ...]], best_own: float) -> Fit | None:
    """The fit with the best effect of the whole arm, if that pays and no joint's own effect is better."""
    there = {effect: tuple(n for n in names if n in search.data.columns) for effect, names in whole.items()}
    there = {effect: names for effect, names in there.items() if names and names[0] not in fit.shared}
    columns = tuple(dict.fromkeys(name for names in there.values() for name in names))
    if not columns:
        return None
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, (*fit.shared, *columns))
    expected = {effect: _expected(search, fit, now, slopes, columns, names) for effect, names in there.items()}
    effect = max(expected, key=lambda each: expected[each])
    names = there[effect]
    if expected[effect] < max(best_own, PRICE * len(names)):
        return None
    point = {**fit.point, **{name: np.zeros(search.data.joints) for name in names}}
    before = search.score(fit)
    trial = improve(search.data, replace(fit, point=point, shared=(*fit.shared, *names)), search.scales, 5)
    fall = before - search.score(trial)
    if fall.sum() < PRICE * len(names) or (fall / search.samples).max() < LEAST_FALL:
        return None
    return trial


def _expected(
    search: Search, fit: Fit, now: Array, slopes: list[Array], columns: tuple[str, ...], names: tuple[str, ...]
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


def pruned(search: Search, fit: Fit) -> Fit:
    """The fit without effects whose removal costs less than their price."""
    for _ in range(3):
        before, best, changed = search.score(fit), fit, False
        removable = [[e for e in effects_at(fit, j) if _removable(search, fit, e, j)] for j in range(search.data.joints)]
        losses: list[list[tuple[float, str, Fit]]] = [[] for _ in removable]
        for rank in range(max((len(each) for each in removable), default=0)):
            tried = {j: each[rank] for j, each in enumerate(removable) if rank < len(each)}
            trial = fit
            for j, effect in tried.items():
                trial = without(search, trial, effect, j)
            kept = trial.active
            trial = replace(improve(search.data, _only(trial, tried), search.scales, 3), active=kept, shared=fit.shared)
            score = search.score(trial)
            for j, effect in tried.items():
                losses[j].append((float(score[j] - before[j]), effect, trial))
        for j, each in enumerate(losses):
            if each:
                loss, effect, trial = min(each, key=lambda item: item[0])
                if loss < price(search, len(EFFECTS[effect].parameters))[j]:
                    best, changed = _merged(best, trial, j), True
        if not changed:
            break
        fit = improve(search.data, best, search.scales, 4)
    return fit


def effects_at(fit: Fit, joint: int) -> list[str]:
    """Effects that are fitted at a joint."""
    return [effect for effect in EFFECTS if effect_there(fit, effect, joint)]


def _removable(search: Search, fit: Fit, effect: str, joint: int) -> bool:
    needed = any(effect in EFFECTS[other].needs for other in effects_at(fit, joint))
    return effect not in search.kept and not needed


def without(search: Search, fit: Fit, effect: str, joint: int) -> Fit:
    """The fit without an effect at one joint: its parameters are those of the nominal model."""
    names = EFFECTS[effect].parameters
    point = {name: values.copy() for name, values in fit.point.items()}
    for name in names:
        point[name][joint] = search.nominal[name][joint]
    active = list(fit.active)
    active[joint] = tuple(name for name in active[joint] if name not in names)
    return replace(fit, point=point, active=tuple(active), rms=None)
