"""Worth of each effect: the gap that it lowers on held-out data, and what would do as well in its place."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.choice import PRICE
from sim_gap.position_gap.choice import About, Group, LoopSearch, groups_of, names_in, without_group
from sim_gap.position_gap.fit import LoopFit, evaluate
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.windows import Windows

LEAST_SHRINK = 0.05
"""Least relative fall of a joint's held-out RMS by a cause; less is a minor one."""
AS_WELL = 0.1
"""Share of an effect's worth that may be lost with another one that would do as well."""
LOOSE = 0.35
"""Relative standard deviation of a gain beside a free rotor from which its scale is not decided."""


def rms_on(data: Windows, fit: LoopFit) -> Array:
    """RMS of the position gap of each joint [rad], (J,)."""
    return joint_rms(data, _rms(data, fit))


def joint_rms(data: Windows, rms: Array) -> Array:
    """RMS over all windows of each joint, (J,)."""
    count = data.weight.sum(0)
    return np.asarray(np.sqrt((rms**2 * count).sum(1) / np.maximum(count.sum(1), 1.0)))


@dataclass(frozen=True, eq=False)
class Stage:
    """One group added to those before it, on held-out data."""

    group: Group
    before: Array
    after: Array
    """(J,) [rad]."""
    share: Array
    """Fall of the RMS in its place or as the last of all, whichever is more, as a share of it, (J,)."""
    evidence: float
    """Fall of the held-out cost of training rows that nothing else would have brought."""
    rivals: tuple[str, ...]
    """Effects that would do as well."""


def stages(search: LoopSearch, fit: LoopFit, about: About, heldout: Windows, matters: Array) -> list[Stage]:
    """The groups in order of what is lost without each, added to the nominal model and those above them.

    `matters` is the gap that counts as one at each joint, (J,) [rad].
    """
    groups = groups_of(fit, search)
    final, floor = rms_on(heldout, fit), search.floor
    alone = {group: rms_on(heldout, without_group(search, fit, group)) for group in groups}
    order = sorted(groups, key=lambda group: -float(((alone[group] - final) / matters).max()))
    fits = [fit]
    for group in reversed(order):
        fits.append(without_group(search, fits[-1], group))
    known = [final, *(alone[group] for group in order[-1:])]
    courses = [*known, *(rms_on(heldout, each) for each in fits[len(known) :])][::-1]
    out = []
    for group, before, after in zip(order, courses[:-1], courses[1:], strict=True):
        falls = [1.0 - np.hypot(b, floor) / np.hypot(a, floor) for a, b in ((before, after), (alone[group], final))]
        share = np.maximum(*falls)
        loss, rivals = _rivals(search, fit, about, group)
        out.append(Stage(group, before, after, share, loss, rivals if (share > LEAST_SHRINK).any() else ()))
    return out


def _rms(data: Windows, fit: LoopFit) -> Array:
    """RMS of every joint and window, (J, W) [rad]."""
    found = evaluate(data, fit).rms
    assert found is not None
    return found


ALWAYS = {"controller.dead_zone": ("transmission.backlash",)}
"""Effects that positions alone never separate."""


def _rivals(search: LoopSearch, fit: LoopFit, about: About, group: Group) -> tuple[float, tuple[str, ...]]:
    """Loss of the held-out cost with the best other effect in a group's place, and those that lose next to nothing."""
    effect, joints = group
    terms, every = about.terms, about.effects
    chosen = [name for each in groups_of(fit, search) for name in names_in(each) if name in every]
    chosen += [name for name in every if name.partition("#")[0] in search.kept and name not in chosen]
    rest = [name for name in chosen if name not in names_in(group)]
    base = float(terms.cost(about.parameters(chosen)).sum())

    def lost(names: Sequence[str]) -> float:
        return float(terms.cost(about.parameters(names)).sum()) - base

    whole = lost(rest)
    if effect == "controller.stiffness":
        return whole, _scale_rivals(search, fit, about, chosen)
    least, close = whole, list(ALWAYS.get(effect, ()))
    others = {name.partition("#")[0].partition("@")[0] for name in every} - {effect.partition("@")[0]}
    for other in sorted(others):
        places = [f"{other}#{j}" for j in joints if f"{other}#{j}" in every]
        if not joints or not places:
            places = max(
                ([name] for name in every if name.partition("@")[0] == other and "#" not in name),
                key=lambda names: -lost([*rest, *names]),
                default=[],
            )
        places = [name for name in places if name not in chosen]
        if places:
            left = lost([*rest, *places])
            least = min(least, left)
            if left < max(PRICE, AS_WELL * whole):
                close.append(other)
    return max(least, 0.0), tuple(dict.fromkeys(close))


def _scale_rivals(search: LoopSearch, fit: LoopFit, about: About, chosen: Sequence[str]) -> tuple[str, ...]:
    """`actuator.rotor_inertia` if beside a free rotor some joint's gain is loose: positions show ratios."""
    terms, places = about.terms, about.layout.names
    for j, own in enumerate(fit.active):
        if "kp" not in own or (j, "armature") not in places or EFFECTS["actuator.rotor_inertia"].id in search.excluded:
            continue
        free = sorted({k for k in about.parameters(chosen) if places[k][0] == j} | {places.index((j, "armature"))})
        index = terms.acting[j].tolist()
        at = [index.index(k) for k in free]
        normal = terms.squares[j].sum(0)[np.ix_(at, at)] / terms.variance[j] + np.diag(terms.prior[free])
        deviation = np.sqrt(np.linalg.pinv(normal, hermitian=True)[(k := free.index(places.index((j, "kp")))), k])
        if deviation > LOOSE:
            return ("actuator.rotor_inertia",)
    return ()
