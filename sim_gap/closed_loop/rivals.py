"""Which other effect would do as well in place of one, seen from positions alone."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.candidates import expected_shared, ranked
from sim_gap.closed_loop.columns import shared_effects
from sim_gap.closed_loop.fit import Fit, improve, jacobian
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import PRICE, Search, with_effect

Group = tuple[str, tuple[int, ...]]
"""An effect with the joints that have it; no joints for one of the whole arm."""
TRIED = 2
"""Number of effects of the whole arm that are tried in place of one."""


def rivals_of(search: Search, fit: Fit, group: Group, bare: Fit) -> tuple[float, tuple[str, ...]]:
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
    if not joints:
        for other, lost in _of_the_arm(search, fit, effect, bare):
            least = min(least, lost)
            if lost < max(PRICE, 0.1 * loss) and other.partition("@")[0] != effect.partition("@")[0]:
                close.append(other.partition("@")[0])
    return least, tuple(dict.fromkeys(close))


def _of_the_arm(search: Search, fit: Fit, effect: str, bare: Fit) -> Iterator[tuple[str, float]]:
    """The most promising other effects of the whole arm, and the loss of the score with each in place of `effect`.

    Each starts where its torque is closest to that of the effect, for gains and friction follow it slowly.
    """
    every, columns = shared_effects(search.data.arm), search.data.columns
    own = tuple(name for name in every[effect] if name in fit.shared)
    others = {
        other: tuple(name for name in names if name in columns)
        for other, names in every.items()
        if other != effect and other.partition("@")[0] not in search.excluded and not {*names} & {*fit.shared}
    }
    offered = tuple(dict.fromkeys(name for names in others.values() for name in names))
    if not offered:
        return
    now, slopes = jacobian(search.data, bare, search.scales, bare.active, (*bare.shared, *offered))
    worth = {
        other: expected_shared(search, bare, now, slopes, offered, names) for other, names in others.items() if names
    }
    torque = sum((fit.point[name][0] * columns[name] for name in own), np.zeros_like(columns[offered[0]]))
    kept = {name: 0.0 * x if name in own else x for name, x in fit.point.items()}
    for other in sorted(worth, key=lambda each: -worth[each])[:TRIED]:
        like = _like(torque, [columns[name] for name in others[other]])
        point = {**kept, **{n: np.full(search.data.joints, c) for n, c in zip(others[other], like, strict=True)}}
        shared = (*(name for name in fit.shared if name not in own), *others[other])
        trial = improve(search.data, replace(fit, point=point, shared=shared, rms=None), search.scales, 5)
        yield other, float((search.score(trial) - search.score(fit)).sum())


def _like(torque: Array, columns: Sequence[Array]) -> Array:
    """Coefficients of columns, (T, J, W) each, whose sum is closest to a torque; every joint counts by its own size."""
    size = 1.0 / np.maximum(np.sqrt(np.mean(torque**2, axis=(0, 2))), 1e-9)[:, None]
    flat = np.stack([(column * size).ravel() for column in columns])
    gram = flat @ flat.T
    return np.asarray(np.linalg.pinv(gram, rcond=1e-9, hermitian=True) @ (flat @ (torque * size).ravel()))


_ALWAYS = {
    "controller.dead_zone": ("transmission.backlash",),
}
"""Effects that positions alone never separate."""


def _scale_rivals(search: Search, fit: Fit) -> tuple[str, ...]:
    """`actuator.rotor_inertia` if some joint's gain can be half as large again with all else fitted around it."""
    point = {name: x.copy() for name, x in fit.point.items()}
    active = [tuple(dict.fromkeys((*(n for n in own if n != "kp"), "armature"))) for own in fit.active]
    point["kp"] = point["kp"] * 1.5
    for name in ("coulomb", "viscous", "kd", "ki", "stribeck", "armature", "dead"):
        point[name] = point[name] * (1.5 if name != "dead" else 1.0)
    trial = improve(search.data, replace(fit, point=point, active=tuple(active), shared=(), rms=None), search.scales, 4)
    lost = search.score(trial) - search.score(fit)
    return ("actuator.rotor_inertia",) if bool((lost < PRICE).any()) else ()
