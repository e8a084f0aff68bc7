"""Which effects of joints and of the whole arm: chosen about a fit, fitted, and chosen again until nothing changes.

Then the worth of each: the gap that it lowers on held-out data, and what would do as well in its place.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from gcomp.estimate.choice import EffectChoice
from gcomp.estimate.linear_terms import PRICE, Effect, LinearTerms, price_of, terms_of
from gcomp.estimate.problem import linearise
from gcomp.estimate.solve import cost_of, prior_cost, scale_of
from sim_gap.position_gap.fit import Group, Layout, LoopFit, LoopSearch, Place, residuals, rms_on
from sim_gap.position_gap.parameters import EFFECTS, PARAMETERS, shared_effects, size_of
from sim_gap.position_gap.plant import Point
from sim_gap.position_gap.windows import Windows, thin
from sim_gap.residuals.residual_set import FOLDS

OF_EVERY_JOINT = "friction.coulomb", "friction.viscous", "actuator.rotor_inertia"
"""Effects that every joint has, of which a model states a guess: they pay no price."""
QUIET = 1.1
"""Noise floors up to which nothing is left to explain."""
ROUNDS, FITTING = 3, 3
"""Times that effects are chosen and fitted, and Gauss-Newton steps of each of these fits."""
FEW = 8
"""Windows on which levels of a limit, or first gains, are compared: those are steps of a factor, not values."""
LEVELS = {
    "slew": (0.2, 0.35, 0.5, 0.65, 0.8, 0.9),
    "limit": (0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0),
}
"""Levels at which a limit is tried: in units of the command's highest speed, of the joint's own torque."""
Progress = Callable[[str], None]


def folds_of(data: Windows) -> NDArray[np.intp]:
    """Fold of each window, (W,): recordings, or parts of a few of them."""
    if len(np.unique(data.recording)) >= FOLDS:
        return np.unique(data.recording, return_inverse=True)[1].astype(np.intp) % FOLDS
    return (np.arange(data.count) * min(FOLDS, data.count) // data.count).astype(np.intp)


def candidates_of(search: LoopSearch) -> list[Group]:
    """Each effect that may act, at one joint or of the whole arm."""
    joints = [j for j in range(search.data.joints) if j not in search.resting]
    own: list[Group] = [(effect, (j,)) for effect in EFFECTS for j in joints if _may_act(search, effect, j)]
    whole: list[Group] = [(effect, ()) for effect in shared_effects(search.arm)]
    return [group for group in own + whole if id_of(group) not in search.excluded]


def id_of(group: Group) -> str:
    """The id of an effect, without the link that it is of."""
    return group[0].partition("@")[0]


def _may_act(search: LoopSearch, effect: str, joint: int) -> bool:
    """Whether the model has what an effect changes: a filter, or what tells a gain of all torques from that of the
    position, a limit or an integral part."""
    nominal = search.nominal
    if effect == "actuator.gain":
        return bool(np.isfinite(nominal["limit"][joint]) or nominal["ki"][joint] > 0.0)
    return effect != "controller.lag" or bool(nominal["lag"][joint] > 0.0)


def chosen_of(search: LoopSearch, fit: LoopFit) -> list[Group]:
    """The candidates that a fit has."""
    return [each for each in candidates_of(search) if {*search.places_of(each)} <= {*fit.free}]


def with_chosen(search: LoopSearch, fit: LoopFit, chosen: Sequence[Group]) -> LoopFit:
    """The fit with these effects free and all others as the nominal model has them."""
    free = [place for each in chosen for place in search.places_of(each)]
    others = [place for each in candidates_of(search) for place in search.places_of(each) if place not in free]
    return put_back(search, fit, others).freed(free)


def put_back(search: LoopSearch, fit: LoopFit, places: Sequence[Place]) -> LoopFit:
    """The fit without these parameters, which are those of the nominal model."""
    point = {name: values.copy() for name, values in fit.point.items()}
    for j, name in places:
        if j >= 0:
            point[name][j] = search.nominal[name][j]
        else:
            point.pop(name, None)
    return replace(fit, point=point).freed(place for place in fit.free if place not in places)


@dataclass(frozen=True, eq=False)
class About:
    """All that may be chosen, linear about a fit."""

    search: LoopSearch
    fit: LoopFit
    layout: Layout
    terms: LinearTerms
    effects: dict[Group, Effect[Group]]

    def parameters(self, chosen: Sequence[Group]) -> frozenset[int]:
        return frozenset(k for each in chosen for k in self.effects[each].parameters)

    def moved(self, chosen: Sequence[Group]) -> LoopFit:
        """The fit with these effects alone, as the linear terms have it."""
        change = self.terms.fit(self.parameters(chosen))
        theta = self.terms.theta + np.clip(np.nan_to_num(change), -3.0, 3.0)
        point = self.layout.at(theta)
        return with_chosen(self.search, replace(self.fit, point=point), chosen)


def look_about(
    search: LoopSearch, fit: LoopFit, some: Container[Group] | None = None, levels: Mapping[str, Array] | None = None
) -> About:
    """Derivatives by all candidates, or some; by an effect that is not there the difference that one of the size at
    which it is tried makes, by a limit that of its level."""
    listed = [each for each in candidates_of(search) if some is None or each in some]
    places = list(dict.fromkeys(place for each in listed for place in search.places_of(each)))
    absent = [place for place in places if place not in fit.free]
    if levels is None:
        levels = {name: best_level(search, fit, name) for name in LEVELS if name in {name for _, name in absent}}
    point = {name: values.copy() for name, values in fit.point.items()}
    steps = dict[Place, float]()
    for j, name in absent:
        if j < 0:
            steps[j, name] = 0.2 * size_of(search.arm, name)
        elif name in LEVELS:
            size = float(search.scales.of(name)[j])
            own = size / float(point[name][j]) if np.isfinite(point[name][j]) else 0.0
            steps[j, name] = size / float(levels[name][j]) - own or 0.05
        elif name == "stribeck_velocity" or name in ("kp", "gain"):
            steps[j, name] = 0.05
        else:
            steps[j, name] = 0.5 if point[name][j] == PARAMETERS[name].neutral else 0.1
    # a Stribeck velocity says nothing without the friction that it is of
    places = [(j, name) for j, name in places if name != "stribeck_velocity" or (j, "stribeck") in fit.free]
    layout = Layout(search, point, places)
    problem = layout.problem(steps)
    about = linearise(problem, layout.theta, range(len(places)))
    at = {place: k for k, place in enumerate(places)}
    effects: dict[Group, Effect[Group]] = {}
    for group in listed:
        effect, joints = group
        numbers = tuple(at[place] for place in search.places_of(group) if place in at)
        needs = tuple(
            (need, joints)
            for need in (EFFECTS[effect].needs if joints else ())
            if not active_in(search.nominal, need, joints[0])
        )
        effects[group] = Effect(group, numbers, needs, price=0.0 if effect in OF_EVERY_JOINT else None)
    return About(search, fit, layout, terms_of(problem, about, folds_of(search.data)), effects)


def active_in(point: dict[str, Array], effect: str, joint: int) -> bool:
    """Whether an effect changes the motion of a joint: its first parameter is not neutral."""
    first = EFFECTS[effect].parameters[0]
    return bool(point[first][joint] != PARAMETERS[first].neutral)


def best_level(search: LoopSearch, fit: LoopFit, name: str) -> Array:
    """The best of some levels of a limit at every joint, (J,): one that is never reached has no slope to follow, and
    one that is always reached leads nowhere."""
    levels = np.minimum(np.array(LEVELS[name])[:, None] * search.size_of(name), fit.point[name])
    few = thin(search.data, FEW, moving=True)
    gaps = residuals(few, [{**fit.point, name: level} for level in levels])
    squares = np.einsum("ptjw,tjw->pj", gaps**2, few.weight)
    return np.asarray(levels[squares.argmin(axis=0), np.arange(search.data.joints)])


def select(search: LoopSearch, fit: LoopFit, progress: Progress = lambda text: None) -> LoopFit:
    """Choose effects about the fit and fit them, until the choice stays; the best fit."""
    names = chosen_of(search, fit)
    kept = [each for each in candidates_of(search) if each[0] in search.kept]
    looked = {*names, *unexplained_at(search, fit)}
    levels = {name: best_level(search, fit, name) for name in LEVELS}
    best, most = fit, worth(search, fit)
    for number in range(ROUNDS):
        progress(f"round {number + 1}: testing {len(names)} effects of joints and arm")
        about = look_about(search, fit, looked, levels)
        found = EffectChoice(about.terms, about.effects, names, kept=kept).run()
        if number == 0:
            looked = {*promising(about, names), *found, *names}
        made = search.improve(entered(search, about.moved(found)), FITTING)
        reached = worth(search, made)
        if not {*names} <= {*found} and reached < most:
            # what was taken out mattered more than the linear terms say: only what comes in does so
            found = [*names, *(name for name in found if name not in names)]
            made = search.improve(entered(search, about.moved(found)), FITTING)
            reached = worth(search, made)
        if reached >= most:
            best, most = made, reached
        if set(found) == set(names):
            break
        names, fit = found, made
    return best


def worth(search: LoopSearch, fit: LoopFit) -> float:
    """Logarithm of the probability of a fit less the price of its parameters, but for a constant."""
    layout = Layout(search, fit.point, fit.free)
    unlikely = prior_cost(layout.problem(), layout.theta, search.data.joints).sum()
    paid = sum(not any(name in EFFECTS[e].parameters for e in OF_EVERY_JOINT) for _, name in fit.free)
    return -float(costs_of(search, [fit.point])[0].sum() + unlikely) - PRICE * paid


def costs_of(search: LoopSearch, points: Sequence[Point]) -> Array:
    """Negative logarithm of the likelihood of each joint at P points, (P, J), but for a constant."""
    problem, left = Layout(search, points[0], ()).problem(), _by_joint(search, points)
    return np.stack([cost_of(problem, each, scale_of(problem, each)) for each in left])


def scale_left(search: LoopSearch, point: Point) -> Array:
    """Scale of the residuals beyond the noise, in which moments of contact count little, (J,) [rad]."""
    scale = scale_of(Layout(search, point, ()).problem(), _by_joint(search, [point])[0])
    return np.asarray(np.sqrt(scale - search.floor**2))


def _by_joint(search: LoopSearch, points: Sequence[Point]) -> Array:
    return residuals(search.data, points).transpose(0, 2, 1, 3).reshape(len(points), search.data.joints, -1)


def unexplained_at(search: LoopSearch, fit: LoopFit) -> list[Group]:
    """Effects of the joints at which a fit leaves more than noise, and of the whole arm if it does anywhere."""
    left = set(np.flatnonzero(rms_on(search.data, fit.point) > QUIET * search.floor).tolist())
    return [(effect, joints) for effect, joints in candidates_of(search) if left and left >= {*joints}]


def promising(about: About, names: Sequence[Group]) -> set[Group]:
    """Effects that would pay beside those there, whatever else does."""
    own = about.parameters(names)
    base = float(about.terms.cost(own).sum())
    return {
        name
        for name, effect in about.effects.items()
        if base - float(about.terms.cost(own | {*effect.parameters}).sum()) > price_of(effect)
    }


def entered(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit with what has just come in and is still neutral at the size at which it is tried."""
    point = {name: values.copy() for name, values in fit.point.items()}
    for j, name in fit.free:
        if j >= 0 and point[name][j] == 0.0 and PARAMETERS[name].neutral == 0.0 and name != "delay":
            point[name][j] = 0.1 * float(search.scales.of(name)[j])
    return replace(fit, point=point)


# ---- an effect put into a fit or taken out of it


def present(search: LoopSearch, fit: LoopFit) -> list[Group]:
    """Effects that a fit has, each with all its joints."""
    joints = {e.id: tuple(j for j, name in fit.free if j >= 0 and name == e.parameters[0]) for e in EFFECTS.values()}
    whole: list[Group] = [(e, ()) for e, names in shared_effects(search.arm).items() if {*names} & {*fit.at(-1)}]
    return [group for group in joints.items() if group[1]] + whole


def groups_of(fit: LoopFit, search: LoopSearch) -> list[Group]:
    """Effects of the fit, without the controller that a model without actuators leaves open."""
    return [group for group in present(search, fit) if not (search.open_controller and group[0] in OPEN)]


OPEN = frozenset(effect.id for effect in EFFECTS.values() if effect.controller) | {
    "actuator.back_emf",
    "friction.viscous",
}
"""Effects that a controller has that had to be found: damping may be the servo's."""


def without_groups(search: LoopSearch, fit: LoopFit, *groups: Group) -> LoopFit:
    return put_back(search, fit, [place for group in groups for place in search.places_of(group)])


def parts_of(group: Group) -> list[Group]:
    """The candidates that a group consists of."""
    effect, joints = group
    return [(effect, (j,)) for j in joints] or [group]


# ---- what each effect is worth

LEAST_SHRINK = 0.05
"""Least relative fall of a joint's held-out RMS by a cause; less is a minor one."""
AS_WELL = 0.1
"""Share of an effect's worth that may be lost with another one that would do as well."""
LOOSE = 0.35
"""Relative standard deviation of a gain beside a free rotor from which its scale is not decided."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One group added to those before it, on held-out data."""

    group: Group
    before: Array
    after: Array
    """(J,) [rad]."""
    share: Array
    """Fall of the RMS in its place or as the last of all, whichever is more, as a share of it, (J,)."""
    worth: float
    """Fall of the held-out cost of training rows by it, all else fitted again without it."""
    evidence: float
    """The part of it that nothing else would have brought."""
    rivals: tuple[str, ...]
    """Effects that would do as well."""


def stages(about: About, heldout: Windows, matters: Array) -> list[Stage]:
    """The groups in order of what is lost without each, added to the nominal model and those above them.

    `matters` is the gap that counts as one at each joint, (J,) [rad].
    """
    search, fit = about.search, about.fit
    groups = groups_of(fit, search)
    final, floor = rms_on(heldout, fit.point), search.floor
    alone = {group: rms_on(heldout, without_groups(search, fit, group).point) for group in groups}
    order = sorted(groups, key=lambda group: -float(((alone[group] - final) / matters).max()))
    fits = [fit]
    for group in reversed(order):
        fits.append(without_groups(search, fits[-1], group))
    known = [final, *(alone[group] for group in order[-1:])]
    courses = [*known, *(rms_on(heldout, each.point) for each in fits[len(known) :])][::-1]
    out = []
    for group, before, after in zip(order, courses[:-1], courses[1:], strict=True):
        falls = [1.0 - np.hypot(b, floor) / np.hypot(a, floor) for a, b in ((before, after), (alone[group], final))]
        share = np.maximum(*falls)
        worth, evidence, rivals = _rivals(about, group)
        shown = worth > PRICE and (share > LEAST_SHRINK).any()
        out.append(Stage(group, before, after, share, worth, evidence, rivals if shown else ()))
    return out


ALWAYS = {"controller.dead_zone": ("transmission.backlash",)}
"""Effects that positions alone never separate."""


def _rivals(about: About, group: Group) -> tuple[float, float, tuple[str, ...]]:
    """Loss of the held-out cost without a group, and with the best other effect in its place; those that lose next to
    nothing."""
    effect, joints = group
    terms, every = about.terms, about.effects
    chosen = [part for each in groups_of(about.fit, about.search) for part in parts_of(each) if part in every]
    chosen += [part for part in every if part[0] in about.search.kept and part not in chosen]
    rest = [part for part in chosen if part not in parts_of(group)]
    base = float(terms.cost(about.parameters(chosen)).sum())

    def lost(parts: Sequence[Group]) -> float:
        return float(terms.cost(about.parameters(parts)).sum()) - base

    whole = least = lost(rest)
    close = list(ALWAYS.get(effect, ()))
    if effect == "controller.stiffness":
        close += _scale_rivals(about, chosen)
    for other in sorted({id_of(part) for part in every} - {id_of(group)}):
        parts = [part for part in parts_of((other, joints)) if joints and part in every]
        if not parts:
            whole_arm = [part for part in every if id_of(part) == other and not part[1]]
            parts = [min(whole_arm, key=lambda part: lost([*rest, part]))] if whole_arm else []
        parts = [part for part in parts if part not in chosen]
        if parts:
            left = lost([*rest, *parts])
            least = min(least, left)
            if left < max(PRICE, AS_WELL * whole):
                close.append(other)
    return whole, max(least, 0.0), tuple(dict.fromkeys(close))


def _scale_rivals(about: About, chosen: Sequence[Group]) -> tuple[str, ...]:
    """`actuator.rotor_inertia` if beside a free rotor some joint's gain is loose: positions show ratios."""
    places = about.layout.places
    for j in range(about.search.data.joints):
        rotor = (j, "armature") in places and "actuator.rotor_inertia" not in about.search.excluded
        if rotor and (j, "kp") in about.fit.free:
            free = about.parameters(chosen) | {places.index((j, "armature"))}
            if about.terms.curvature(np.array([places.index((j, "kp"))]), free)[0, 0] < 1.0 / LOOSE**2:
                return ("actuator.rotor_inertia",)
    return ()
