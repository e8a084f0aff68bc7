"""Worth of each effect: the gap that it lowers on held-out data, and what would do as well in its place."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.choice import PRICE
from sim_gap.position_gap.choice import About, groups_of, id_of, parts_of, without_group
from sim_gap.position_gap.fit import Group, LoopFit, LoopSearch, rms_on
from sim_gap.position_gap.windows import Windows

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
    evidence: float
    """Fall of the held-out cost of training rows that nothing else would have brought."""
    rivals: tuple[str, ...]
    """Effects that would do as well."""


def stages(search: LoopSearch, fit: LoopFit, about: About, heldout: Windows, matters: Array) -> list[Stage]:
    """The groups in order of what is lost without each, added to the nominal model and those above them.

    `matters` is the gap that counts as one at each joint, (J,) [rad].
    """
    groups = groups_of(fit, search)
    final, floor = rms_on(heldout, fit.point), search.floor
    alone = {group: rms_on(heldout, without_group(search, fit, group).point) for group in groups}
    order = sorted(groups, key=lambda group: -float(((alone[group] - final) / matters).max()))
    fits = [fit]
    for group in reversed(order):
        fits.append(without_group(search, fits[-1], group))
    known = [final, *(alone[group] for group in order[-1:])]
    courses = [*known, *(rms_on(heldout, each.point) for each in fits[len(known) :])][::-1]
    out = []
    for group, before, after in zip(order, courses[:-1], courses[1:], strict=True):
        falls = [1.0 - np.hypot(b, floor) / np.hypot(a, floor) for a, b in ((before, after), (alone[group], final))]
        share = np.maximum(*falls)
        loss, rivals = _rivals(search, fit, about, group)
        out.append(Stage(group, before, after, share, loss, rivals if (share > LEAST_SHRINK).any() else ()))
    return out


ALWAYS = {"controller.dead_zone": ("transmission.backlash",)}
"""Effects that positions alone never separate."""


def _rivals(search: LoopSearch, fit: LoopFit, about: About, group: Group) -> tuple[float, tuple[str, ...]]:
    """Loss of the held-out cost with the best other effect in a group's place, and those that lose next to nothing."""
    effect, joints = group
    terms, every = about.terms, about.effects
    chosen = [part for each in groups_of(fit, search) for part in parts_of(each) if part in every]
    chosen += [part for part in every if part[0] in search.kept and part not in chosen]
    rest = [part for part in chosen if part not in parts_of(group)]
    base = float(terms.cost(about.parameters(chosen)).sum())

    def lost(parts: Sequence[Group]) -> float:
        return float(terms.cost(about.parameters(parts)).sum()) - base

    whole = least = lost(rest)
    close = list(ALWAYS.get(effect, ()))
    if effect == "controller.stiffness":
        close += _scale_rivals(search, fit, about, chosen)
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
    return max(least, 0.0), tuple(dict.fromkeys(close))


def _scale_rivals(search: LoopSearch, fit: LoopFit, about: About, chosen: Sequence[Group]) -> tuple[str, ...]:
    """`actuator.rotor_inertia` if beside a free rotor some joint's gain is loose: positions show ratios."""
    places = about.layout.places
    for j in range(search.data.joints):
        rotor = (j, "armature") in places and "actuator.rotor_inertia" not in search.excluded
        if rotor and (j, "kp") in fit.free:
            free = about.parameters(chosen) | {places.index((j, "armature"))}
            if about.terms.curvature(np.array([places.index((j, "kp"))]), free)[0, 0] < 1.0 / LOOSE**2:
                return ("actuator.rotor_inertia",)
    return ()
