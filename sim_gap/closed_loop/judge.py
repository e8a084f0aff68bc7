"""What each effect is worth: its interval, and what it lowers on held-out data."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.columns import UNIT, shared_effects
from sim_gap.closed_loop.fit import LOGARITHMIC, Fit, evaluate, improve, jacobian, moved
from sim_gap.closed_loop.parameters import EFFECTS, PARAMETERS
from sim_gap.closed_loop.rivals import rivals_of
from sim_gap.closed_loop.search import Group, Search, effect_there, taken_out
from sim_gap.closed_loop.training.limits import Unreached, draw_limits
from sim_gap.closed_loop.windows import Windows

SYSTEMATIC = 0.02
"""Relative standard deviation of every parameter that no recording shows: sampling, command timing, the model's own."""
LEAST_SHRINK = 0.05
"""Least relative fall of a joint's held-out RMS by a cause; less is a minor one."""
LOOSE = 0.35
"""Relative standard deviation of a gain from which its scale is not decided."""


def groups_of(fit: Fit, search: Search) -> list[Group]:
    """Effects of the fit, without the controller that a model without actuators leaves open."""
    own = [
        (effect, tuple(j for j in range(search.data.joints) if effect_there(fit, effect, j)))
        for effect in EFFECTS
        if not (search.open_controller and effect in search.kept)
    ]
    return [group for group in own if group[1]] + [(effect, ()) for effect in shared_of(fit, search)]


def shared_of(fit: Fit, search: Search) -> list[str]:
    """Effects of the whole arm that a fit has."""
    return [e for e, names in shared_effects(search.data.arm).items() if set(names) & set(fit.shared)]


def rms_on(data: Windows, fit: Fit) -> Array:
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
    """What it lowers in its place or as the last of all, whichever is more, as a share of the RMS, (J,)."""
    evidence: float
    """Fall of the training score that nothing else would have brought."""
    rivals: tuple[str, ...]
    """Effects that would do as well."""


def stages(search: Search, fit: Fit, heldout: Windows, matters: Array) -> list[Stage]:
    """The groups in order of what each lowers when it is added to the nominal model and those above it.

    `matters` is the gap that counts as one at each joint, (J,) [rad].
    """
    groups = groups_of(fit, search)

    def with_only(some: Sequence[Group]) -> Fit:
        """The fit without the other groups, the rest fitted again from where it is."""
        left = fit
        for group in groups:
            if group not in some:
                left = taken_out(search, left, group)
        return improve(search.data, left, search.scales, 4)

    current = with_only(())
    before, final, out = _rms(heldout, current), _rms(heldout, fit), []
    for number, (group, trial) in enumerate(_ordered(search, groups, with_only, current, matters), start=1):
        after = final if number == len(groups) else _rms(heldout, trial)
        bare = improve(search.data, taken_out(search, fit, group), search.scales, 4)
        falls = [_shrink(search, heldout, *pair) for pair in ((before, after), (_rms(heldout, bare), final))]
        share = np.maximum(*falls)
        lowers = bool((share > LEAST_SHRINK).any())
        evidence, rivals = rivals_of(search, fit, group, bare) if lowers else (0.0, ())
        out.append(Stage(group, joint_rms(heldout, before), joint_rms(heldout, after), share, evidence, rivals))
        before = after
    return out


def _rms(data: Windows, fit: Fit) -> Array:
    """RMS of every joint and window, (J, W) [rad]."""
    found = evaluate(data, fit).rms
    assert found is not None
    return found


def _shrink(search: Search, data: Windows, before: Array, after: Array) -> Array:
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
    search: Search,
    groups: Sequence[Group],
    with_only: Callable[[Sequence[Group]], Fit],
    current: Fit,
    margin: Array,
) -> Iterator[tuple[Group, Fit]]:
    """The groups, each the one that lowers the training gap most beside those before it, with the fit up to there.

    A group that was worth less than another beside fewer groups is not tried again until that one is worth less too,
    or until an effect that it needs is there.
    """
    worth = {group: float("inf") for group in groups}
    fresh: dict[Group, Fit] = {}
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


def _worth(search: Search, current: Fit, trial: Fit, margin: Array) -> float:
    """Largest fall of a joint's RMS in units of what matters there, by a group."""
    assert current.rms is not None
    assert trial.rms is not None
    fall = joint_rms(search.data, current.rms) - joint_rms(search.data, trial.rms)
    return float((fall / margin).max())


def undecided_scale(fit: Fit, spread: "Covariance") -> list[int]:
    """Joints of which only ratios of gain, friction and inertia can be told."""
    places = {j: spread.names.index((j, "kp")) for j, own in enumerate(fit.active) if "kp" in own}
    return [j for j, at in places.items() if float(spread.matrix[at, at]) > LOOSE**2]


@dataclass(frozen=True, eq=False)
class Covariance:
    """What the recordings leave open: covariance of the fitted parameters in their own coordinates (`fit.moved`), and
    the limits that no recording reaches."""

    names: list[tuple[int, str]]
    """Joint (−1: whole arm) and name."""
    matrix: Array
    limits: tuple[Unreached, ...] = ()


def covariance(search: Search, fit: Fit) -> Covariance:
    """Sandwich covariance over the windows, which holds for residuals that are correlated within each."""
    now, slopes = jacobian(search.data, fit, search.scales, fit.active, fit.shared)
    names = [(j, name) for j, own in enumerate(fit.active) for name in own] + [(-1, name) for name in fit.shared]
    starts = np.concatenate([[0], np.cumsum([len(own) for own in fit.active])]).astype(int)
    size, count = len(names), search.data.count
    bread, scores = np.zeros((size, size)), np.zeros((count, size))
    for j, x in enumerate(slopes):
        r = now[:, j]
        weight = 1.0 / max(float((r**2).sum()), 1e-300)
        index = np.concatenate([np.arange(starts[j], starts[j + 1]), np.arange(starts[-1], size)]).astype(int)
        bread[np.ix_(index, index)] += weight * np.einsum("atw,btw->ab", x, x)
        scores[:, index] += weight * np.einsum("atw,tw->wa", x, r)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(bread), 1e-300))
    prior = np.diag([1e-4] * size)  # a parameter that nothing shows keeps a finite spread
    inverse = np.linalg.inv(bread * scale * scale[:, None] + prior) * scale * scale[:, None]
    meat = scores.T @ scores
    matrix = inverse @ meat @ inverse * count / max(count - size / max(search.data.joints, 1), 1.0)
    own = np.array([1.0 if name in LOGARITHMIC else abs(coordinate(search, fit, j, name)) for j, name in names])
    return Covariance(names, matrix + np.diag((SYSTEMATIC * own) ** 2))


def coordinate(search: Search, fit: Fit, joint: int, name: str) -> float:
    """A parameter's value in its own coordinate, in which `fit.moved` steps."""
    if joint < 0:
        return float(fit.point[name][0])
    if name in LOGARITHMIC:
        return float(np.log(fit.point[name][joint]))
    return float(fit.point[name][joint]) / float(search.scales.of(name)[joint])


def interval(search: Search, fit: Fit, spread: Covariance, joint: int, name: str) -> tuple[float, float, float, str]:
    """Value, ends of its 95 % interval, and unit."""
    half = 2.0 * float(np.sqrt(spread.matrix[(at := spread.names.index((joint, name))), at]))
    if joint < 0:
        value = float(fit.point[name][0])
        return value, value - half, value + half, UNIT[name.partition(".")[2]]
    value = float(fit.point[name][joint])
    low, high = (moved(name, value, sign * half, search.scales, joint) for sign in (-1.0, 1.0))
    return value, low, high, PARAMETERS[name].unit


def draw(search: Search, fit: Fit, spread: Covariance, count: int, seed: int = 0) -> list[dict[str, float]]:
    """Draws of all fitted parameters from their joint distribution, within their bounds, and of the limits that no
    recording reaches: `joint.name` → value."""
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(spread.matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    steps = random.standard_normal((count, len(values))) @ root.T
    rows = [_sample(search, fit, spread.names, row) for row in steps]
    for each, drawn in zip(spread.limits, draw_limits(spread.limits, count, random), strict=True):
        for row, value in zip(rows, drawn, strict=True):
            row[f"{search.data.arm.names[each.joint]}.{each.name}"] = float(value)
    return rows


def _sample(search: Search, fit: Fit, names: Sequence[tuple[int, str]], steps: Array) -> dict[str, float]:
    out: dict[str, float] = {}
    labels: Mapping[int, str] = dict(enumerate(search.data.arm.names))
    for (joint, name), step in zip(names, steps, strict=True):
        if joint < 0:
            out[name] = float(fit.point[name][0] + step)
        else:
            value = moved(name, float(fit.point[name][joint]), float(step), search.scales, joint)
            out[f"{labels[joint]}.{name}"] = value
    return out
