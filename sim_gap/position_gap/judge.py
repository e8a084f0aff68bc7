"""Worth of each effect: the gap that it lowers on held-out data."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.fit import LoopFit, evaluate, improve
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.rivals import rivals_of
from sim_gap.position_gap.search import Group, LoopSearch, effect_there, shared_of, without_group
from sim_gap.position_gap.windows import Windows

LEAST_SHRINK = 0.05
"""Least relative fall of a joint's held-out RMS by a cause; less is a minor one."""


def groups_of(fit: LoopFit, search: LoopSearch) -> list[Group]:
    """Effects of the fit, without the controller that a model without actuators leaves open."""
    own = [
        (effect, tuple(j for j in range(search.data.joints) if effect_there(fit, effect, j)))
        for effect in EFFECTS
        if not (search.open_controller and effect in search.kept)
    ]
    return [group for group in own if group[1]] + [(effect, ()) for effect in shared_of(fit, search)]


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
    """Fall of the training score that nothing else would have brought."""
    rivals: tuple[str, ...]
    """Effects that would do as well."""


def stages(search: LoopSearch, fit: LoopFit, heldout: Windows, matters: Array) -> list[Stage]:
    """The groups in order of what each lowers when it is added to the nominal model and those above it.

    `matters` is the gap that counts as one at each joint, (J,) [rad].
    """
    groups = groups_of(fit, search)

    def with_only(some: Sequence[Group]) -> LoopFit:
        """The fit without the other groups, the rest fitted again from where it is."""
        left = fit
        for group in groups:
            if group not in some:
                left = without_group(search, left, group)
        return improve(search.data, left, search.scales, 4)

    current = with_only(())
    before, final, out = _rms(heldout, current), _rms(heldout, fit), []
    for number, (group, trial) in enumerate(_ordered(search, groups, with_only, current, matters), start=1):
        after = final if number == len(groups) else _rms(heldout, trial)
        bare = improve(search.data, without_group(search, fit, group), search.scales, 4)
        falls = [_shrink(search, heldout, *pair) for pair in ((before, after), (_rms(heldout, bare), final))]
        share = np.maximum(*falls)
        lowers = bool((share > LEAST_SHRINK).any())
        evidence, rivals = rivals_of(search, fit, group, bare) if lowers else (0.0, ())
        out.append(Stage(group, joint_rms(heldout, before), joint_rms(heldout, after), share, evidence, rivals))
        before = after
    return out


def _rms(data: Windows, fit: LoopFit) -> Array:
    """RMS of every joint and window, (J, W) [rad]."""
    found = evaluate(data, fit).rms
    assert found is not None
    return found


def _shrink(search: LoopSearch, data: Windows, before: Array, after: Array) -> Array:
    """Relative fall of each joint's RMS, over all windows or in the typical one, whichever is larger, (J,).

    Where held-out motion shows what no training motion did, such as a motor at its limit, a few windows make up the RMS
    over all.
    """
    floor = search.floor[:, None]
    counts = (data.weight.sum(0) > 0).astype(float)
    ratio = np.log(np.hypot(after, floor) / np.hypot(before, floor))
    typical = 1.0 - np.exp((ratio * counts).sum(1) / np.maximum(counts.sum(1), 1.0))
    whole = 1.0 - joint_rms(data, np.hypot(after, floor)) / joint_rms(data, np.hypot(before, floor))
    return np.asarray(np.maximum(typical, whole))


def _ordered(
    search: LoopSearch,
    groups: Sequence[Group],
    with_only: Callable[[Sequence[Group]], LoopFit],
    current: LoopFit,
    margin: Array,
) -> Iterator[tuple[Group, LoopFit]]:
    """The groups, each the one that lowers the training gap most beside those before it, with the fit up to there.

    A group that was worth less than another beside fewer groups is not tried again until that one is worth less too,
    or until an effect that it needs is there.
    """
    worth = {group: float("inf") for group in groups}
    fresh: dict[Group, LoopFit] = {}
    chosen: list[Group] = []
    while worth:
        group = max(worth, key=lambda each: worth[each])
        if group in fresh:
            current = fresh[group]
            chosen.append(group)
            del worth[group]
            worth |= {other: float("inf") for other in worth if group[0] in _needs(other)}
            fresh = {}
            yield group, current
        else:
            fresh[group] = with_only([*chosen, group])
            worth[group] = _worth(search, current, fresh[group], margin)


def _needs(group: Group) -> tuple[str, ...]:
    return EFFECTS[group[0]].needs if group[0] in EFFECTS else ()


def _worth(search: LoopSearch, current: LoopFit, trial: LoopFit, margin: Array) -> float:
    """Largest fall of a joint's RMS in units of what matters there, by a group."""
    assert current.rms is not None
    assert trial.rms is not None
    fall = joint_rms(search.data, current.rms) - joint_rms(search.data, trial.rms)
    return float((fall / margin).max())
