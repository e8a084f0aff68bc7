"""Which effects of joints and of the whole arm: chosen about a fit, fitted, and chosen again until nothing changes."""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from gcomp.estimate.choice import PRICE, Effect, LinearTerms, choose, price_of, terms_of
from gcomp.estimate.solve import cost_of, prior_cost, scale_of
from sim_gap.position_gap.fit import Layout, LoopFit, LoopSearch, Place, Point, residuals, rms_on
from sim_gap.position_gap.parameters import EFFECTS, PARAMETERS, shared_effects, size_of
from sim_gap.position_gap.windows import Windows, thin_moving

FOLDS = 6
"""Parts of the windows of which each is held out once."""
LEAST_FALL = 0.025
"""Least relative fall of a joint's RMS by an effect: half of what makes a cause (`judge.LEAST_SHRINK`), which may come
as two effects at first."""
OF_EVERY_JOINT = "friction.coulomb", "friction.viscous", "actuator.rotor_inertia"
"""Effects that every joint has, of which a model states a guess: they pay no price."""
QUIET = 1.1
"""Noise floors up to which nothing is left to explain."""
ROUNDS, FITTING = 3, 6
"""Times that effects are chosen and fitted, and Gauss-Newton steps of each of these fits."""
FEW = 8
"""Windows on which levels of a limit, or first gains, are compared: those are steps of a factor, not values."""
LEVELS = {
    "slew": (0.2, 0.35, 0.5, 0.65, 0.8, 0.9),
    "limit": (0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0),
}
"""Levels at which a limit is tried: in units of the command's highest speed, of the joint's own torque."""
Progress = Callable[[str], None]
Group = tuple[str, tuple[int, ...]]
"""An effect with the joints that have it; no joints for one of the whole arm."""


def folds_of(data: Windows) -> NDArray[np.intp]:
    """Fold of each window, (W,): recordings, or parts of a few of them."""
    if len(np.unique(data.recording)) >= FOLDS:
        return np.unique(data.recording, return_inverse=True)[1].astype(np.intp) % FOLDS
    return (np.arange(data.count) * min(FOLDS, data.count) // data.count).astype(np.intp)


def candidates_of(search: LoopSearch) -> dict[str, tuple[Place, ...]]:
    """Name of each effect that may act, as `effect#joint` or of the whole arm → its parameters."""
    out: dict[str, tuple[Place, ...]] = {}
    for effect in EFFECTS.values():
        if effect.id not in search.excluded:
            for j in range(search.data.joints):
                if j not in search.resting and _may_act(search, effect.id, j):
                    out[f"{effect.id}#{j}"] = tuple((j, name) for name in effect.parameters)
    for name, parameters in shared_effects(search.data.plant.sim.arm).items():
        if name.partition("@")[0] not in search.excluded:
            out[name] = tuple((-1, each) for each in parameters)
    return out


def _may_act(search: LoopSearch, effect: str, joint: int) -> bool:
    """Whether the model has what an effect changes: a filter, or what tells a gain of all torques from that of the
    position, a limit or an integral part."""
    nominal = search.nominal
    if effect == "actuator.gain":
        return bool(np.isfinite(nominal["limit"][joint]) or nominal["ki"][joint] > 0.0)
    return effect != "controller.lag" or bool(nominal["lag"][joint] > 0.0)


def chosen_of(search: LoopSearch, fit: LoopFit) -> list[str]:
    """Names of the effects that a fit has."""
    return [name for name, places in candidates_of(search).items() if all(fit.has(place) for place in places)]


def with_chosen(search: LoopSearch, fit: LoopFit, names: Sequence[str]) -> LoopFit:
    """The fit with these effects active and all others as the nominal model has them."""
    every = candidates_of(search)
    places = [place for name in names for place in every[name]]
    active = tuple(tuple(n for j, n in places if j == joint) for joint in range(search.data.joints))
    shared = tuple(n for j, n in places if j < 0)
    point = {name: values.copy() for name, values in fit.point.items()}
    for own in every.values():
        for j, name in own:
            if j >= 0 and name not in active[j]:
                point[name][j] = search.nominal[name][j]
            elif j < 0 and name not in shared:
                point.pop(name, None)
    return replace(fit, point=point, active=active, shared=shared)


@dataclass(frozen=True, eq=False)
class About:
    """All that may be chosen, linear about a fit."""

    search: LoopSearch
    fit: LoopFit
    layout: Layout
    terms: LinearTerms
    effects: dict[str, Effect[str]]

    def parameters(self, names: Sequence[str]) -> frozenset[int]:
        return frozenset(k for name in names for k in self.effects[name].parameters)

    def moved(self, names: Sequence[str]) -> LoopFit:
        """The fit with these effects alone, as the linear terms have it."""
        change = self.terms.fit(self.parameters(names))
        theta = self.terms.theta + np.clip(np.nan_to_num(change), -3.0, 3.0)
        point = self.layout.at(theta)
        return with_chosen(self.search, replace(self.fit, point=point), names)


def look_about(
    search: LoopSearch, fit: LoopFit, names: Container[str] | None = None, levels: Mapping[str, Array] | None = None
) -> About:
    """Derivatives by all candidates, or those named; an effect that is not there by the difference that one of the size
    at which it is tried makes, a limit by that of its level."""
    every = candidates_of(search)
    listed = [name for name in every if names is None or name in names]
    places = list(dict.fromkeys(place for name in listed for place in every[name]))
    absent = [place for place in places if not fit.has(place)]
    if levels is None:
        levels = {name: best_level(search, fit, name) for name in LEVELS if any(name == n for _, n in absent)}
    # the velocity over which breakaway friction fades says nothing without that friction
    places = [place for place in places if place[1] != "stribeck_velocity" or fit.has((place[0], "stribeck"))]
    steps = {place: _trial_step(search, fit, place, levels) for place in absent}
    search = search.looked(fit, places, steps)
    layout = search.layout(fit.point, places)
    terms = terms_of(layout.problem(search.nominal, search.floor), search.linear(fit, places), folds_of(search.data))
    at = {place: k for k, place in enumerate(places)}
    samples = search.samples
    effects = {}
    for name in listed:
        joint, own = every[name][0][0], name.partition("#")[0]
        least = LEAST_FALL * float(samples[joint] if joint >= 0 else samples.mean())
        needs = EFFECTS[own].needs if joint >= 0 else ()
        effects[name] = Effect(
            name,
            tuple(at[place] for place in every[name] if place in at),
            tuple(f"{need}#{joint}" for need in needs if not active_in(search.nominal, need, joint)),
            least,
            0.0 if own in OF_EVERY_JOINT else None,
        )
    return About(search, fit, layout, terms, effects)


def _trial_step(search: LoopSearch, fit: LoopFit, place: Place, levels: Mapping[str, Array]) -> float:
    """Step of a difference by a parameter that is not there, in its own coordinate."""
    j, name = place
    if j < 0:
        return 0.2 * size_of(search.data.plant.sim.arm, name)
    value = float(fit.point[name][j])
    if name in LEVELS:
        size = float(search.scales.of(name)[j])
        return size / float(levels[name][j]) - (size / value if np.isfinite(value) else 0.0) or 0.05
    if name in ("stribeck_velocity", "kp", "gain"):
        return 0.05
    return 0.5 if value == PARAMETERS[name].neutral else 0.1


def active_in(point: dict[str, Array], effect: str, joint: int) -> bool:
    """Whether an effect changes the motion of a joint: its first parameter is not neutral."""
    first = EFFECTS[effect].parameters[0]
    return bool(point[first][joint] != PARAMETERS[first].neutral)


def best_level(search: LoopSearch, fit: LoopFit, name: str) -> Array:
    """The best of some levels of a limit at every joint, (J,): one that is never reached has no slope to follow, and
    one that is always reached leads nowhere."""
    levels = np.minimum(np.array(LEVELS[name])[:, None] * search.size_of(name), fit.point[name])
    few = thin_moving(search.data, FEW)
    gaps = residuals(few, [{**fit.point, name: level} for level in levels])
    squares = np.einsum("ptjw,tjw->pj", gaps**2, few.weight)
    return np.asarray(levels[squares.argmin(axis=0), np.arange(search.data.joints)])


def select(search: LoopSearch, fit: LoopFit, progress: Progress = lambda text: None) -> tuple[LoopFit, About]:
    """Choose effects about the fit and fit them, until the choice stays; the best fit, and what was looked at last.

    After the first time only those are looked at that were worth their price by themselves or are there.
    """
    names = chosen_of(search, fit)
    every = candidates_of(search)
    kept = [n for n in every if n.partition("#")[0] in search.kept]
    looked = {*names, *unexplained_at(search, fit)}
    levels = {name: best_level(search, fit, name) for name in LEVELS}
    best, most = fit, worth(search, fit)
    for number in range(ROUNDS):
        progress(f"round {number + 1}: {len(names)} effects of joints and arm")
        about = look_about(search, fit, looked, levels)
        search = about.search
        found = choose(about.terms, list(about.effects.values()), names, kept)
        if number == 0:
            looked = {*promising(about, names), *found, *names}
        begin = about.moved(found)
        if not {*names} <= {*found}:
            # what was taken out may matter more than the linear terms say: then only what comes in does so
            more = [*names, *(name for name in found if name not in names)]
            whole = about.moved(more)
            if worth(search, whole) > worth(search, begin):
                found, begin = more, whole
        made = search.improve(begin, FITTING)
        reached = worth(search, made)
        same, names, fit = set(found) == set(names), found, made
        if reached >= most:
            best, most = made, reached
        if same:
            break
    if not same or best is not fit:
        fit, names = best, chosen_of(search, best)
        about = look_about(search, fit, looked, levels)
    found = choose(about.terms, [about.effects[n] for n in names], names, kept)
    if set(found) != set(names):
        made = about.search.improve(about.moved(found), FITTING)
        if worth(search, made) >= most:
            fit = made
    return fit, about


def worth(search: LoopSearch, fit: LoopFit) -> float:
    """Logarithm of the probability of a fit less the price of its parameters, but for a constant."""
    layout = search.layout(fit.point, fit.places)
    problem = layout.problem(search.nominal, search.floor)
    unlikely = prior_cost(problem, layout.theta(layout.point), search.data.joints).sum()
    paid = sum(not any(name in EFFECTS[e].parameters for e in OF_EVERY_JOINT) for _, name in layout.names)
    return -float(costs_of(search, [fit.point])[0].sum() + unlikely) - PRICE * paid


def costs_of(search: LoopSearch, points: Sequence[Point]) -> Array:
    """Negative logarithm of the likelihood of each joint at P points, (P, J), but for a constant."""
    layout = search.layout(points[0])
    problem = layout.problem(search.nominal, search.floor)
    return np.stack([cost_of(problem, x, scale_of(problem, x)) for x in layout.rows(residuals(search.data, points))])


def unexplained_at(search: LoopSearch, fit: LoopFit) -> list[str]:
    """Effects of the joints at which a fit leaves more than noise, and of the whole arm if it does anywhere."""
    left = set(np.flatnonzero(rms_on(search.data, fit) > QUIET * search.floor).tolist())
    return [
        name for name, places in candidates_of(search).items() if (places[0][0] in left if places[0][0] >= 0 else left)
    ]


def promising(about: About, names: Sequence[str]) -> set[str]:
    """Effects that would pay beside those there, whatever else does."""
    own = about.parameters(names)
    base = float(about.terms.cost(own).sum())
    return {
        name
        for name, effect in about.effects.items()
        if base - float(about.terms.cost(own | {*effect.parameters}).sum()) > price_of(effect)
    }


# ---- effects of a fit, and the fit without them


def effect_there(fit: LoopFit, effect: str, joint: int) -> bool:
    return fit.has((joint, EFFECTS[effect].parameters[0]))


def groups_of(fit: LoopFit, search: LoopSearch) -> list[Group]:
    """Effects of the fit, without the controller that a model without actuators leaves open."""
    own = [
        (effect, tuple(j for j in range(search.data.joints) if effect_there(fit, effect, j)))
        for effect in EFFECTS
        if not (search.open_controller and effect in OPEN)
    ]
    every = shared_effects(search.data.plant.sim.arm)
    return [group for group in own if group[1]] + [(e, ()) for e, names in every.items() if {*names} & {*fit.shared}]


OPEN = frozenset(effect.id for effect in EFFECTS.values() if effect.controller) | {
    "actuator.back_emf",
    "friction.viscous",
}
"""Effects that a controller has that had to be found: damping may be the servo's."""


def without_group(search: LoopSearch, fit: LoopFit, group: Group) -> LoopFit:
    """The fit without an effect: its parameters are those of the nominal model."""
    effect, joints = group
    every = shared_effects(search.data.plant.sim.arm)
    names = {*(EFFECTS[effect].parameters if joints else every[effect])}
    point = {name: values.copy() for name, values in fit.point.items() if joints or name not in names}
    active = list(fit.active)
    for j in joints:
        active[j] = tuple(name for name in active[j] if name not in names)
        for name in names:
            point[name][j] = search.nominal[name][j]
    shared = fit.shared if joints else tuple(name for name in fit.shared if name not in names)
    return replace(fit, point=point, active=tuple(active), shared=shared)


def names_in(group: Group) -> list[str]:
    """Names of a group among the candidates."""
    effect, joints = group
    return [f"{effect}#{j}" for j in joints] or [effect]
