"""The controller at the start: that of the model's own actuators, else the simplest one that follows the recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from gcomp.arrays import Array, Mask
from sim_gap.model.load import SimModel
from sim_gap.position_gap.fit import LoopFit, batch, evaluate, improve, residuals
from sim_gap.position_gap.parameters import EFFECTS, PARAMETERS, Scales
from sim_gap.position_gap.search import PRICE, LoopSearch
from sim_gap.position_gap.selection import Progress
from sim_gap.position_gap.windows import Windows, thin_moving

STARTING_FRICTIONS = 0.0, 0.4
"""Least Coulomb friction that is tried with each stiffness, as a share of the gain times the RMS error."""
RESTS_RAD = 0.002
"""Way of a command over all recordings below which it rests [rad]."""
HOLDS_HZ = 5.0, 30.0
"""Least and highest natural frequency of the controller that is assumed for a joint that rests [Hz]."""
KINDS: dict[str, tuple[str, ...]] = {
    "P": ("delay",),
    "PD": ("kd", "delay"),
    "PID": ("kd", "ki", "delay"),
    "P with feed-forward": ("feed", "delay"),
    "PD with feed-forward": ("kd", "feed", "delay"),
    "PID with feed-forward": ("kd", "ki", "feed", "delay"),
}
"""Controllers that are compared if the model has none: what they have besides a stiffness. The delay is that of the
command, which may have been written before or after its row's time."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """Controller of the model's own position actuators, (J,) each; NaN gains at a joint without one."""

    kp: Array
    kv: Array
    ki: Array
    limit: Array
    slew: Array
    delay: Array

    @property
    def complete(self) -> bool:
        return bool(np.isfinite(self.kp).all())


def nominal_controller(sim: SimModel) -> Nominal:
    """Gains, limits and delays of the model's position actuators, PID ones among them."""
    import mujoco

    model: Any = sim.mujoco_model
    none, unlimited = np.zeros(sim.n), np.full(sim.n, np.inf)
    own = Nominal(np.full(sim.n, np.nan), none.copy(), none.copy(), unlimited.copy(), unlimited.copy(), none.copy())
    joints = {int(joint): j for j, joint in enumerate(sim.joints)}
    for i in range(model.nu):
        j = joints.get(int(model.actuator_trnid[i, 0]))
        is_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        if j is None or not is_joint or not affine or model.actuator_biasprm[i, 1] >= 0.0:
            continue
        gear = float(model.actuator_gear[i, 0])
        own.kp[j], own.kv[j] = -model.actuator_biasprm[i, 1] * gear**2, -model.actuator_biasprm[i, 2] * gear**2
        if model.actuator_forcelimited[i]:
            own.limit[j] = float(np.abs(model.actuator_forcerange[i]).max()) * abs(gear)
        if model.jnt_actfrclimited[sim.joints[j]]:  # as URDF states it, for all actuators of a joint
            own.limit[j] = min(own.limit[j], float(np.abs(model.jnt_actfrcrange[sim.joints[j]]).max()))
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_PID:
            own.ki[j], slew = model.actuator_gainprm[i, 0] * gear**2, float(model.actuator_dynprm[i, 1])
            own.slew[j] = slew / abs(gear) if slew > 0.0 else np.inf
        own.delay[j] = model.actuator_delay[i]
    return own


def nominal_point(data: Windows, own: Nominal) -> dict[str, Array]:
    """Parameters of the nominal model at every joint, neutral where it says nothing."""
    arm, one = data.arm, np.ones(data.joints)
    point = {name: p.neutral * one for name, p in PARAMETERS.items()}
    point |= {"coulomb": arm.frictionloss.copy(), "armature": arm.armature.copy()}
    point["viscous"] = arm.damping + np.where(np.isfinite(own.kp), own.kv, 0.0)
    point["kp"] = np.where(np.isfinite(own.kp), own.kp, 1.0)
    point["kv"] = np.where(np.isfinite(own.kp), own.kv, 0.0)
    point |= {"ki": own.ki.copy(), "limit": own.limit.copy(), "slew": own.slew.copy(), "delay": own.delay.copy()}
    point["spring"], point["offset"] = arm.stiffness.copy(), -arm.stiffness * arm.rest
    return point | {name: np.zeros(data.joints) for name in data.columns}


def scales_of(data: Windows) -> Scales:
    """Natural sizes of each joint along the recordings."""
    flat = (0, 2)
    accelerated = data.inertia * data.a
    torque = np.sqrt(np.mean((data.gravity + data.coupling + accelerated) ** 2, axis=flat))
    speed = np.sqrt(np.mean(data.v**2, axis=flat))
    inertia = data.inertia.mean(flat) + data.arm.armature
    torque = np.maximum(torque, inertia * np.sqrt(np.mean(data.a**2, axis=flat)) + 1e-6)
    served = np.maximum(data.served.sum(flat), 1.0)
    error = np.sqrt((data.served * (data.command - data.recorded) ** 2).sum(flat) / served)
    return Scales(torque, torque / np.maximum(speed, 0.05), inertia, np.maximum(error, 1e-4))


def starting_fit(search: LoopSearch, own: Nominal, progress: Progress) -> tuple[LoopSearch, LoopFit, str]:
    """A fit of controller, Coulomb and viscous friction; the search that keeps that controller; the controller's name.

    With position actuators in the model the controller is of their kind; without, the simplest of `KINDS` that does not
    score clearly worse than the best. Damping is part of a controller that has to be found: of all damping, or, where
    the servo is off at times, of that while it is on.
    """
    always_on = "actuator.back_emf" in search.excluded
    servo: tuple[str, ...] = () if own.complete or always_on else ("back_emf",)
    kinds = {"P": ()} if own.complete else {kind: (*parts, *servo) for kind, parts in KINDS.items()}
    if not own.complete and always_on:  # then all damping may be the servo's, which ends at a limit of its torque
        search = replace(search, nominal={**search.nominal, "kv": np.full(search.data.joints, np.inf)})
    at_rest = rests(search.data)
    search = replace(search, resting=frozenset(np.flatnonzero(at_rest).tolist()))
    search = replace(search, nominal=_holding(search, at_rest & ~np.isfinite(own.kp)))
    few = replace(search, data=thin_moving(search.data, 8))  # windows on which controllers are compared
    fits: dict[str, LoopFit] = {}
    scores: dict[str, float] = {}
    for kind, parts in kinds.items():
        progress(f"controller: {kind}")
        needed = () if own.complete else ("kp", "viscous", *parts)
        start = _at_rest(search, _as_excluded(few, _from_grid(few, parts), needed))
        fits[kind] = improve(few.data, start, search.scales, 5)
        scores[kind] = float(few.score(fits[kind])[~at_rest].sum()) + PRICE * int((~at_rest).sum()) * len(parts)
    kind = min(scores, key=lambda name: scores[name])
    kept = {"controller.stiffness"} | {
        e.id for e in EFFECTS.values() if e.controller and e.parameters[0] in kinds[kind]
    }
    if not own.complete:
        kept.add("friction.viscous" if always_on else "actuator.back_emf")  # damping that the servo may make
    left_out = {"controller.feed_forward"} if not own.complete else set()
    if "feed" not in kinds[kind]:
        left_out.add("actuator.gain")
    found = replace(search, kept=frozenset(kept), excluded=search.excluded | left_out)
    if not own.complete:
        point = dict(found.nominal)
        for name in ("kp", *kinds[kind]):
            point[name] = fits[kind].point[name]
        found = replace(found, nominal=point, open_controller=True)
    return found, replace(fits[kind], rms=None), kind


def rests(data: Windows) -> Mask:
    """Joints whose command rests in all windows, (J,): any controller holds them there. One that has none swings."""
    on = data.served > 0.5
    ends = [find(np.where(on, data.command, fill), axis=(0, 2)) for find, fill in ((np.max, -np.inf), (np.min, np.inf))]
    return np.asarray(on.any(axis=(0, 2)) & (ends[0] - ends[1] < RESTS_RAD))


def _holding(search: LoopSearch, joints: Mask) -> dict[str, Array]:
    """The nominal values, with a controller at joints (J,) that rest and have none: critically damped, and as stiff as
    gravity and the error at rest tell, within bounds; a simulation has to hold them.
    """
    data, held = search.data, dict(search.nominal)
    inertia, flat = search.scales.inertia, (0, 2)
    pull, error = (np.sqrt(np.mean(each**2, axis=flat)) for each in (data.gravity, data.command - data.recorded))
    seen = np.sqrt(pull / np.maximum(error, 1e-6) / inertia)
    frequency = np.clip(seen, 2.0 * np.pi * HOLDS_HZ[0], 2.0 * np.pi * HOLDS_HZ[1])
    held["kp"] = np.where(joints, inertia * frequency**2, held["kp"])
    held["viscous"] = np.where(joints, 2.0 * inertia * frequency, held["viscous"])
    return held


def _at_rest(search: LoopSearch, fit: LoopFit) -> LoopFit:
    """The fit with the nominal values at the joints that rest."""
    if not search.resting:
        return fit
    point = {name: values.copy() for name, values in fit.point.items()}
    for j in search.resting:
        for name in point:
            point[name][j] = search.nominal[name][j]
    return replace(
        fit, point=point, active=tuple(() if j in search.resting else own for j, own in enumerate(fit.active)), rms=None
    )


def _as_excluded(search: LoopSearch, fit: LoopFit, needed: Sequence[str]) -> LoopFit:
    """The fit with parameters of excluded effects as the model has them, apart from those `needed`."""
    own = [name for effect in search.excluded & EFFECTS.keys() for name in EFFECTS[effect].parameters]
    held = [name for name in own if name not in needed]
    active = tuple(tuple(name for name in each if name not in held) for each in fit.active)
    return replace(fit.with_values(**{name: search.nominal[name].copy() for name in held}), active=active, rms=None)


def _from_grid(search: LoopSearch, parts: Sequence[str]) -> LoopFit:
    """The best stiffness of a coarse grid at every joint, with damping and friction that go with it."""
    data, nominal, on = search.data, search.nominal, search.data.served
    e, v = on * (data.command - data.recorded), data.v
    needed = data.gravity + data.coupling + (data.inertia + nominal["armature"][:, None]) * data.a
    feed = on * data.feed if "feed" in parts else np.zeros_like(data.feed)
    asked = np.sqrt(np.mean((on * needed - feed) ** 2, axis=(0, 2)))
    size = asked / np.maximum(np.sqrt(np.mean(e**2, axis=(0, 2))), 1e-6)
    centre = np.maximum(size, search.scales.inertia * 25.0)
    points = []
    for factor, stuck in product(np.geomspace(0.02, 50.0, 12), STARTING_FRICTIONS):
        kp = centre * factor
        point = {name: values.copy() for name, values in nominal.items()}
        point["kp"] = kp
        if "kd" in parts:
            point["kd"] = 1.4 * np.sqrt(kp * search.scales.inertia)
        if "ki" in parts:
            point["ki"] = 0.5 * kp
        if "feed" in parts:
            point["feed"] = np.ones(data.joints)
        for j in range(data.joints):
            rest = kp[j] * e[:, j] + feed[:, j] - needed[:, j]
            if "kd" in parts:
                rest = rest + point["kd"][j] * on[:, j] * (data.speed[:, j] - v[:, j])
            columns = np.stack([np.tanh(v[:, j] / 0.02).ravel(), v[:, j].ravel(), (on * v)[:, j].ravel()])
            columns = columns[: 3 if "back_emf" in parts else 2]
            coulomb = float(np.linalg.lstsq(columns.T, rest.ravel(), rcond=None)[0][0])
            coulomb = max(coulomb, stuck * kp[j] * float(search.scales.angle[j]))
            left = rest.ravel() - coulomb * columns[0]
            viscous, *servo = np.linalg.lstsq(columns[1:].T, left, rcond=None)[0].tolist()
            point["coulomb"][j], point["viscous"][j] = coulomb, max(viscous, 1e-3 * kp[j])
            point["back_emf"][j] = max(*servo, 0.0) if servo else nominal["back_emf"][j]
        points.append(point)
    gaps = residuals(data, batch(points))
    costs = np.einsum("ptjw,ptjw->pj", gaps, gaps)
    best = costs.argmin(0)
    point = {name: np.array([points[b][name][j] for j, b in enumerate(best)]) for name in points[0]}
    active = ("kp", *(part for part in parts if part != "feed"), "coulomb", "viscous")
    return evaluate(data, LoopFit(point, (active,) * data.joints))
