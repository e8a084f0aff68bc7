"""Which other effect would do as well in place of one, seen from positions alone."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.columns import shared_effects
from sim_gap.position_gap.fit import LoopFit, improve, jacobian
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.search import PRICE, Group, LoopSearch, with_effect, without_group
from sim_gap.position_gap.selection import expected_shared, ranked


def rivals_of(search: LoopSearch, fit: LoopFit, group: Group, bare: LoopFit) -> tuple[float, tuple[str, ...]]:
    """Loss of the score with the best other effect in a group's place, and those effects that lose next to nothing.

    `bare` is the fit without the group.
    """
    effect, joints = group
    assert fit.rms is not None
    base = search.score(fit)
    loss = float((search.score(bare) - base).sum())
    if effect == "controller.stiffness":
        return loss, _scale_rivals(search, fit)
    others = [e for e in EFFECTS if e != effect and e not in search.excluded]
    j = max(joints, key=lambda i: float((search.score(bare) - base)[i]), default=-1)
    close: list[str] = list(_ALWAYS.get(effect, ()))
    least = loss
    places = [j] if j >= 0 else [int(np.argmax(search.score(bare) - base))]
    whole = float((search.score(bare) - base)[places[0]]) if j >= 0 else loss
    for place in places:
        for _, other in ranked(search, bare, others)[place][:2]:
            trial = with_effect(search, bare, other, place)
            only = replace(
                trial, active=tuple(own if k == place else () for k, own in enumerate(trial.active)), shared=()
            )
            score = search.score(improve(search.data, only, search.scales, 4))
            lost = float(score[place] - base[place]) if j >= 0 else float((score - base).sum())
            least = min(least, lost + max(loss - whole, 0.0))
            if lost < max(PRICE, 0.1 * whole):
                close.append(other)
    for other, lost in _of_the_arm(search, fit, group, bare):
        least = min(least, lost)
        if lost < max(PRICE, 0.1 * loss) and other.partition("@")[0] != effect.partition("@")[0]:
            close.append(other.partition("@")[0])
    return least, tuple(dict.fromkeys(close))


def _of_the_arm(search: LoopSearch, fit: LoopFit, group: Group, bare: LoopFit) -> Iterator[tuple[str, float]]:
    """The effects of the whole arm in place of a group that acts as a torque along the motion, each with the loss of
    the score with it there.

    Each is tried at its most promising link or joint, and starts where its torque is closest to that of the group, for
    gains and friction follow it slowly.
    """
    torque = _torque_of(search, fit, group)
    if torque is None:
        return
    every, columns = shared_effects(search.data.arm), search.data.columns
    others = {
        other: tuple(name for name in names if name in columns)
        for other, names in every.items()
        if other != group[0] and other.partition("@")[0] not in search.excluded and not {*names} & {*fit.shared}
    }
    offered = tuple(dict.fromkeys(name for names in others.values() for name in names))
    if not offered:
        return
    now, slopes = jacobian(search.data, bare, search.scales, bare.active, (*bare.shared, *offered))
    worth = {
        other: expected_shared(search, bare, now, slopes, offered, names) for other, names in others.items() if names
    }
    rest = without_group(search, fit, group)
    tried: dict[str, str] = {}
    for other in sorted(worth, key=lambda each: -worth[each]):
        tried.setdefault(other.partition("@")[0], other)
    for other in tried.values():
        like = _like(torque, [columns[name] for name in others[other]])
        values = {name: np.full(search.data.joints, c) for name, c in zip(others[other], like, strict=True)}
        start = replace(rest.with_values(**values), shared=(*rest.shared, *others[other]))
        trial = improve(search.data, start, search.scales, 5)
        yield other, float((search.score(trial) - search.score(fit)).sum())


def _torque_of(search: LoopSearch, fit: LoopFit, group: Group) -> Array | None:
    """Torque of a group along the recorded motion, (T, J, W); None of one that is no such torque."""
    effect, joints = group
    data = search.data
    zero = np.zeros_like(data.recorded)

    def change(name: str) -> Array:
        return np.asarray(fit.point[name] - search.nominal[name])[:, None]

    if not joints:
        names = [name for name in shared_effects(data.arm)[effect] if name in fit.shared]
        return sum((change(name) * data.columns[name] for name in names), zero)
    if effect != "transmission.spring":
        return None
    torque = change("spring") * data.recorded + change("offset")
    return np.where(np.isin(np.arange(data.joints), joints)[:, None], torque, zero)


def _like(torque: Array, columns: Sequence[Array]) -> Array:
    """Coefficients of columns, (T, J, W) each, whose sum is closest to a torque; every joint counts by its own size."""
    size = 1.0 / np.maximum(np.sqrt(np.mean(torque**2, axis=(0, 2))), 1e-9)[:, None]
    flat = np.stack([(column * size).ravel() for column in columns])
    gram = flat @ flat.T
    return np.asarray(np.linalg.pinv(gram, rcond=1e-9, hermitian=True) @ (flat @ (torque * size).ravel()))


_ALWAYS = {"controller.dead_zone": ("transmission.backlash",)}
"""Effects that positions alone never separate."""


def _scale_rivals(search: LoopSearch, fit: LoopFit) -> tuple[str, ...]:
    """`actuator.rotor_inertia` if some joint's gain can be half as large again with all else fitted around it."""
    point = {name: x.copy() for name, x in fit.point.items()}
    active = [tuple(dict.fromkeys((*(n for n in own if n != "kp"), "armature"))) for own in fit.active]
    point["kp"] = point["kp"] * 1.5
    for name in ("coulomb", "viscous", "kd", "ki", "stribeck", "armature", "dead"):
        point[name] = point[name] * (1.5 if name != "dead" else 1.0)
    trial = improve(search.data, replace(fit, point=point, active=tuple(active), shared=(), rms=None), search.scales, 4)
    lost = search.score(trial) - search.score(fit)
    return ("actuator.rotor_inertia",) if bool((lost < PRICE).any()) else ()
