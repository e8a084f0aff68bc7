"""The corrected model as MJCF with native position actuators: gains, delay, limits, friction, masses, gravity, ranges.

Friction for which MJCF has no field is left out of the model that is to be used alone; beside another model a module
applies it. A model that stops where the arm was seen to go on cannot follow it: its ranges are as wide as was seen.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.better_model.corrected_model import (
    body_parameters,
    closest_possible,
    mass_centre_inertia,
    mujoco_quaternion,
    spec_of,
)
from sim_gap.better_model.forward_effects import JointEffect
from sim_gap.better_model.native_drives import LONGEST_STEP_S, put_delay
from sim_gap.better_model.urdf import xml_comment
from sim_gap.effects.base import tilt_gravity
from sim_gap.effects.link import point_mass
from sim_gap.model.load import SimModel
from sim_gap.model.solver_friction import solver_parameters
from sim_gap.position_gap.choice import LoopSearch, effect_there, without_effect, without_group
from sim_gap.position_gap.fit import LoopFit
from sim_gap.position_gap.links import along, shared_effects
from sim_gap.position_gap.parameters import EFFECTS

BEYOND = 0.02
"""Distance beyond the end of its range from which a joint of the model would have to go on [rad]; stops are soft."""
FELT_NM, ALIKE = 1e-3, 0.03
"""Torque from which a joint feels gravity [N·m], and difference of two joints' shares of it that are taken for one."""
BESIDE = 0.01
"""Room beside the positions and commands that were seen [rad]."""


def widen_ranges(sim: SimModel, recordings: Sequence[Recording]) -> SimModel:
    """The model with `arm.range` widened to the recorded positions, where they leave it."""
    ranges = sim.arm.range.copy()
    seen = np.concatenate([recording.position for recording in recordings])
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    ranges[:, 0] = np.where(low < ranges[:, 0] - BEYOND, low - BESIDE, ranges[:, 0])
    ranges[:, 1] = np.where(high > ranges[:, 1] + BEYOND, high + BESIDE, ranges[:, 1])
    return replace(sim, arm=replace(sim.arm, range=ranges))


def widened_joints(sim: SimModel) -> list[int]:
    own = sim.mujoco_model.jnt_range[list(sim.joints)]
    limited = sim.mujoco_model.jnt_limited[list(sim.joints)].astype(bool)
    wider = (sim.arm.range[:, 0] < own[:, 0]) | (sim.arm.range[:, 1] > own[:, 1])
    return [int(j) for j in np.flatnonzero(limited & wider)]


def write_range(joint: Any, actuator: Any, ends: Array, unit: float) -> None:
    """Let a joint of a file, and commands to it, go as far as the ends (2,) [rad]; a joint's angles in its `unit`."""
    low, high = ends.tolist()
    joint.range = [unit * low, unit * high]
    if actuator.ctrllimited and actuator.ctrlrange[0] < actuator.ctrlrange[1]:
        actuator.ctrlrange = [min(actuator.ctrlrange[0], low), max(actuator.ctrlrange[1], high)]


NATIVE = {
    "controller.stiffness": "actuator kp",
    "controller.delay": "actuator delay",
    "controller.lag": "actuator dynprm",
    "controller.slew": "actuator slewmax",
    "controller.integral": "actuator ki",
    "actuator.saturation": "actuator forcerange",
    "actuator.back_emf": "actuator kv",
    "actuator.rotor_inertia": "joint armature",
    "friction.coulomb": "joint frictionloss",
    "friction.viscous": "joint damping",
    "friction.creep": "joint solimpfriction",
    "transmission.spring": "joint stiffness and springref",
    "link.payload": "body inertial",
    "link.mass_moment": "body inertial",
    "base.tilt": "option gravity",
}
"""Effects that a field of MJCF holds."""
BATCHED = frozenset(NATIVE) - {"controller.slew", "controller.integral"}
"""Effects that MuJoCo Warp can run too: it has no PID actuator, which slew limit and integral part need."""
IN_MODULE = "friction.stribeck", "friction.load", "friction.asymmetric"
"""Effects that the module beside a model applies."""
WRITTEN = frozenset({*NATIVE, *IN_MODULE})
"""Effects of a model with its module."""
POSITION_INPUT = 1
"""MuJoCo's code of an actuator whose only input is a position."""


@dataclass(frozen=True)
class Exported:
    """A corrected model: its text, and a line per effect that it cannot hold."""

    xml: str
    lines: tuple[str, ...]
    fit: LoopFit
    """Parameters that it was written with."""
    effects: tuple[JointEffect, ...] = ()
    """Those that a module applies beside it."""


def native_fit(search: LoopSearch, fit: LoopFit, held: Collection[str] = NATIVE) -> LoopFit:
    """The fit with what a simulator holds alone, the rest fitted around it again."""
    bare = fit
    for effect in EFFECTS:
        if effect in held:
            continue
        for j in range(search.data.joints):
            if effect_there(fit, effect, j):
                bare = without_effect(search, bare, effect, j)
    for effect in _shared_beside(search, fit, held):
        bare = without_group(search, bare, (effect, ()))
    share = compensation(search, fit)
    if share is None:
        share = np.full(search.data.joints, search.data.plant.compensated)
    bare = bare.with_values(kd=np.zeros(search.data.joints), feed=share)
    loaded = fit.point["load"] * np.abs(search.data.torque).mean(axis=(0, 2))
    dry = fit.point["stribeck"] * ("friction.stribeck" not in held) + loaded * ("friction.load" not in held)
    bare = bare.with_values(coulomb=np.maximum(bare.point["coulomb"], fit.point["coulomb"] + dry))
    # a PID actuator, which holds slew limit and integral part, has no filter: a delay takes its place
    unfiltered = (search.data.plant.servos.lag > 0.0) & needs_pid(bare, held)
    late = bare.point["delay"] + np.where(unfiltered, bare.point["lag"], 0.0)
    bare = bare.with_values(lag=np.where(unfiltered, 0.0, bare.point["lag"]), delay=late)
    again = [("coulomb", "viscous", "delay") if lost else ("coulomb", "viscous") for lost in unfiltered]
    wanted = [
        (*(n for n in own if n != "lag" or not lost), *(n for n in more if n not in own))
        for own, more, lost in zip(bare.active, again, unfiltered, strict=True)
    ]
    changed = (bare.active, bare.shared) != (fit.active, fit.shared) or bool(unfiltered.any())
    changed = changed or bool(np.any(fit.point["kd"] != 0.0) or np.any(fit.point["feed"] != share))
    if not changed:
        return fit
    return search.improve(replace(bare, active=tuple(wanted), rms=None), 3)


def needs_pid(fit: LoopFit, held: Collection[str] = NATIVE) -> Mask:
    """Joints at which only a PID actuator holds what was found, (J,)."""
    found = (fit.point["ki"] > 0.0) | np.isfinite(fit.point["slew"])
    return found & ("controller.slew" in held)


def compensation(search: LoopSearch, fit: LoopFit) -> Array | None:
    """Share of gravity that the controller makes up for, the same at all joints that feel it, (J,); None if it differs,
    which no body's `gravcomp` holds."""
    arm, share = search.data.plant.sim.arm, fit.point["feed"]
    q = search.data.first.T
    feels = np.abs(arm.torque(q, 0.0 * q, 0.0 * q)).max(0) > FELT_NM
    if not feels.any() or np.ptp(share[feels]) > ALIKE:
        return None
    return np.full(search.data.joints, float(share[feels].mean()))


def effects_left_out(search: LoopSearch, fit: LoopFit, held: Collection[str] = NATIVE) -> list[str]:
    """Effects of a fit that a simulator which has those `held` lacks, with their joints."""
    names = search.data.plant.sim.arm.names
    return sorted(
        {effect.replace("@", " ") for effect in _shared_beside(search, fit, held)}
        | {
            f"{effect} {name}"
            for effect in EFFECTS
            for j, name in enumerate(names)
            if effect not in held and effect_there(fit, effect, j)
            if effect != "controller.feed_forward" or compensation(search, fit) is None
        }
    )


def export_fit(
    sim: SimModel, search: LoopSearch, fit: LoopFit, native: LoopFit, held: Collection[str] = NATIVE
) -> Exported:
    """MJCF of the native fit, which has the effects `held`, and the effects of the whole fit that it leaves out."""
    spec, left = spec_of(sim), effects_left_out(search, fit, held)
    compiled = spec.compile()
    unit = float(np.degrees(1.0)) if spec.compiler.degree else 1.0
    wider = widened_joints(sim)
    for j, joint in enumerate(sim.joints):
        _set_joint(spec.joints[joint], native, j, unit)
        actuator = _set_actuator(spec, spec.joints[joint].name, search, native, j)
        if j in wider:
            write_range(spec.joints[joint], actuator, sim.arm.range[j], unit)
    for link, change in _link_changes(search, native).items():
        _set_body(spec, compiled, sim.joints[link], change)
    angles = [along(native.point, f"tilt.angle_{k}") for k in (1, 2)]
    spec.option.gravity = tilt_gravity(sim.arm.gravity, np.array(angles))
    if any(actuator.delay > 0.0 for actuator in spec.actuators):
        spec.option.timestep = min(float(spec.option.timestep), LONGEST_STEP_S)
    if (share := float(native.point["feed"][0])) != search.data.plant.compensated:
        for body in search.data.plant.carried():
            spec.bodies[body].gravcomp = share
    _set_friction(spec, sim, search, native)
    spec.compile()
    head = "These effects are left out, since MJCF has no field for them (the other effects were fitted without them):"
    comment = xml_comment([head, *left]) if left else ""
    return Exported(comment + spec.to_xml(), tuple(left), native)


def export_with_module(sim: SimModel, search: LoopSearch, fit: LoopFit) -> Exported | None:
    """MJCF that is to be used with a module for friction that MJCF cannot hold; None if there is no such friction."""
    if not any(effect_there(fit, effect, j) for effect in IN_MODULE for j in range(sim.n)):
        return None
    return export_beside_module(sim, search, fit, native_fit(search, fit, WRITTEN))


def export_beside_module(sim: SimModel, search: LoopSearch, fit: LoopFit, native: LoopFit) -> Exported:
    """MJCF of a native fit, with the effects that a module applies beside it and those of the whole fit left out."""
    effects: list[JointEffect] = []
    for effect in IN_MODULE:
        own = EFFECTS[effect]
        for j in range(sim.n):
            if effect_there(native, effect, j):
                pairs = zip(own.reported, own.parameters, strict=True)
                values = {called: float(native.point[name][j]) for called, name in pairs}
                effects.append((effect, sim.arm.names[j], values))
    return replace(export_fit(sim, search, fit, native, WRITTEN), effects=tuple(effects))


def _shared_beside(search: LoopSearch, fit: LoopFit, held: Collection[str]) -> list[str]:
    """Effects of the whole arm in a fit that are not among those held."""
    return [
        effect
        for effect, names in shared_effects(search.data.plant.sim.arm).items()
        if effect.partition("@")[0] not in held and {*names} & {*fit.shared}
    ]


def _set_joint(joint: Any, fit: LoopFit, j: int, unit: float) -> None:
    """Give a joint of a file what the fit has; angles of joints in the file's `unit`."""
    joint.frictionloss, joint.armature = float(fit.point["coulomb"][j]), float(fit.point["armature"][j])
    joint.damping[0] = float(fit.point["viscous"][j] - _of_servo(fit, j))
    stiffness = float(fit.point["spring"][j])
    if stiffness > 1e-9:
        joint.stiffness[0] = stiffness
        joint.springref = -unit * float(fit.point["offset"][j]) / stiffness


def _set_friction(spec: Any, sim: SimModel, search: LoopSearch, fit: LoopFit) -> None:
    """Let the joints of a file rest under friction, or creep as fast as the fit has them, where that is not as fast as
    in the model: with MuJoCo's usual solver parameters a joint creeps to where no friction is needed, within a tenth of
    a second on a small arm.
    """
    made, own = spec.compile(), search.data.plant.creep
    for j, number in enumerate(sim.joints):
        if fit.point["creep"][j] == own[j]:
            continue
        joint, weight = spec.joints[number], float(made.dof_invweight0[made.jnt_dofadr[number]])
        level = float(fit.point["coulomb"][j] + fit.point["stribeck"][j])
        values = solver_parameters(level, float(fit.point["creep"][j]), weight)
        joint.solref_friction, joint.solimp_friction = values


def _of_servo(fit: LoopFit, j: int) -> float:
    """Part of the damping that the model's own actuator makes."""
    return float(min(fit.point["kv"][j], fit.point["viscous"][j]))


def _set_actuator(spec: Any, joint: str, search: LoopSearch, fit: LoopFit, j: int) -> Any:
    """One position actuator at a joint: the model's own, or a new one where there is none, several, or where only a PID
    one holds what was found."""
    import mujoco

    own = search.data.plant
    old = [a for a in spec.actuators if a.target == joint and a.trntype == mujoco.mjtTrn.mjTRN_JOINT]
    kp, ki = (float(fit.point[name][j] * fit.point["gain"][j]) for name in ("kp", "ki"))
    slew, kv = float(fit.point["slew"][j]), float(fit.point["back_emf"][j]) + _of_servo(fit, j)
    limit, delay = float(fit.point["limit"][j] * fit.point["gain"][j]), float(fit.point["delay"][j])
    pid = ki > 0.0 or bool(np.isfinite(slew))
    kept = len(old) == 1 and bool(own.driven[j]) and not pid and not bool(own.pid[j])
    if kept:
        made, gear = old[0], float(own.gear[j])
        made.gainprm[0], made.biasprm[1], made.biasprm[2] = kp / gear**2, -kp / gear**2, -kv / gear**2
        limit /= abs(gear)
        if own.servos.lag[j] > 0.0:
            made.dynprm[0] = max(float(fit.point["lag"][j]), own.dt)
    else:
        name = old[0].name if old else f"position_{joint}"
        control = list(old[0].ctrlrange) if old and old[0].ctrlrange[0] < old[0].ctrlrange[1] else None
        for actuator in old:
            spec.delete(actuator)
        made = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if pid:
            made.set_to_pid(
                kp=kp,
                kv=kv,
                ctrlspec=POSITION_INPUT,
                **({"ki": ki} if ki > 0.0 else {}),
                **({"slewmax": slew} if np.isfinite(slew) else {}),
            )
        else:
            made.set_to_position(kp=kp, kv=kv)
        if control is not None:
            made.ctrllimited, made.ctrlrange = 1, control
    if np.isfinite(limit) and not (kept and fit.point["limit"][j] == own.servos.limit[j]):
        made.forcelimited, made.forcerange = 1, [-limit, limit]
    if not kept or delay != own.servos.delay[j]:
        put_delay(made, delay)
    return made


def _link_changes(search: LoopSearch, fit: LoopFit) -> dict[int, Array]:
    """Change of the ten inertial parameters of each link, about its joint and in its frame."""
    n = search.data.joints
    changes: dict[int, Array] = {}
    mass, *moment = (along(fit.point, f"payload.{part}") for part in ("mass", "x", "y", "z"))
    if mass or any(moment):
        changes[n - 1] = point_mass(mass, np.array(moment))
    for link in range(n):
        moved = np.array([along(fit.point, f"moment{link}.{axis}") for axis in "xyz"])
        if moved.any():
            changes[link] = changes.get(link, np.zeros(10))
            changes[link][1:4] += moved
    return changes


def _set_body(spec: Any, compiled: Any, joint: int, change: Array) -> None:
    """Add a change of inertial parameters to the body that a joint moves."""

    index = int(compiled.jnt_bodyid[joint])
    anchor = compiled.jnt_pos[joint]
    total = body_parameters(compiled, index, anchor, np.eye(3)) + change
    mass, centre, about = mass_centre_inertia(total)
    values, turned = np.linalg.eigh(about)
    turned[:, 2] *= np.sign(np.linalg.det(turned))
    quaternion = np.zeros(4)
    mujoco_quaternion(quaternion, turned)
    body = spec.bodies[index]
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat = mass, anchor + centre, quaternion
    body.inertia = closest_possible(values)
    body.fullinertia = [np.nan] * 6
