"""The corrected model as MJCF with native position actuators: gains, delay, limits, friction, masses, gravity, ranges.

Friction for which MJCF has no field is left out of the model that is to be used alone; beside another model a module
applies it. A model that stops where the arm was seen to go on cannot follow it: its ranges are as wide as was seen.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from armlink.model_file import add_actuator
from armlink.recording.recording import Recording
from calib.arm.model_files import xml_comment
from gcomp.arrays import Array, Mask
from sim_gap.better_model.export import HELD, CorrectedText, write_changes
from sim_gap.better_model.forward_effects import STEP_S, JointEffect
from sim_gap.better_model.native_drives import put_delay
from sim_gap.model.load import SimModel, named_spec
from sim_gap.position_gap.choice import id_of, present, without_groups
from sim_gap.position_gap.fit import Group, LoopFit, LoopSearch
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.plant import MovedModel

FELT_NM, ALIKE = 1e-3, 0.03
"""Torque from which a joint feels gravity [N·m], and difference of two joints' shares of it that are taken for one."""
ROOM = 0.01
"""Room of a widened range beside the positions that were seen [rad]. Stops are soft: a range is widened if a joint went
beyond it by more than twice that."""


def widen_ranges(sim: SimModel, recordings: Sequence[Recording]) -> SimModel:
    """The model with `arm.range` widened to the recorded positions, where they leave it."""
    ranges = sim.arm.range.copy()
    seen = np.concatenate([recording.position for recording in recordings])
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    ranges[:, 0] = np.where(low < ranges[:, 0] - 2.0 * ROOM, low - ROOM, ranges[:, 0])
    ranges[:, 1] = np.where(high > ranges[:, 1] + 2.0 * ROOM, high + ROOM, ranges[:, 1])
    return replace(sim, arm=replace(sim.arm, range=ranges))


def widened_joints(sim: SimModel) -> list[int]:
    own = sim.mujoco_model.jnt_range[list(sim.joints)]
    limited = sim.mujoco_model.jnt_limited[list(sim.joints)].astype(bool)
    wider = (sim.arm.range[:, 0] < own[:, 0]) | (sim.arm.range[:, 1] > own[:, 1])
    return [int(j) for j in np.flatnonzero(limited & wider)]


NATIVE = {
    "controller.stiffness": "actuator kp",
    "controller.delay": "actuator delay",
    "controller.lag": "actuator dynprm",
    "controller.slew": "actuator slewmax",
    "controller.integral": "actuator ki",
    "actuator.saturation": "actuator forcerange",
    "actuator.back_emf": "actuator kv",
    "friction.creep": "joint solimpfriction",
    **{name: HELD[name] for name in HELD if name in {*EFFECTS, "link.payload", "link.mass_moment", "base.tilt"}},
}
"""Effects that a field of MJCF holds."""
BATCHED = frozenset(NATIVE) - {"controller.slew", "controller.integral"}
"""Effects that MuJoCo Warp can run too: it has no PID actuator, which slew limit and integral part need."""
IN_MODULE = "friction.stribeck", "friction.load", "friction.asymmetric"
"""Effects that the module beside a model applies."""
WRITTEN = frozenset({*NATIVE, *IN_MODULE})
"""Effects of a model with its module."""


@dataclass(frozen=True)
class Exported(CorrectedText):
    fit: LoopFit = field(kw_only=True)
    """Parameters that it was written with."""


def native_fit(search: LoopSearch, fit: LoopFit, held: Collection[str] = NATIVE) -> LoopFit:
    """The fit with what a simulator holds alone, the rest fitted around it again."""
    bare = without_groups(search, fit, *_not_held(search, fit, held))
    share = compensation(search, fit)
    if share is None:
        share = np.full(search.data.joints, search.data.plant.compensated)
    bare = bare.with_values(kd=np.zeros(search.data.joints), feed=share)
    loaded = fit.point["load"] * np.abs(search.data.torque).mean(axis=(0, 2))
    dry = fit.point["stribeck"] * ("friction.stribeck" not in held) + loaded * ("friction.load" not in held)
    bare = bare.with_values(coulomb=np.maximum(bare.point["coulomb"], fit.point["coulomb"] + dry))
    # a PID actuator, which holds slew limit and integral part, has no filter: a delay takes its place
    unfiltered = (search.data.plant.servo["lag"] > 0.0) & needs_pid(bare, held)
    late = bare.point["delay"] + np.where(unfiltered, bare.point["lag"], 0.0)
    bare = bare.with_values(lag=np.where(unfiltered, 0.0, bare.point["lag"]), delay=late)
    changed = bare.free != fit.free or bool(unfiltered.any())
    changed = changed or bool(np.any(fit.point["kd"] != 0.0) or np.any(fit.point["feed"] != share))
    if not changed:
        return fit
    free = [(j, name) for j, name in bare.free if name != "lag" or not unfiltered[j]]
    for j, lost in enumerate(unfiltered):
        free += [(j, "coulomb"), (j, "viscous"), *([(j, "delay")] if lost else [])]
    return search.improve(bare.freed(free), 3)


def needs_pid(fit: LoopFit, held: Collection[str] = NATIVE) -> Mask:
    """Joints at which only a PID actuator holds what was found, (J,)."""
    found = (fit.point["ki"] > 0.0) | np.isfinite(fit.point["slew"])
    return found & ("controller.slew" in held)


def compensation(search: LoopSearch, fit: LoopFit) -> Array | None:
    """Share of gravity that the controller makes up for, the same at all joints that feel it, (J,); None if it differs,
    which no body's `gravcomp` holds."""
    arm, share = search.arm, fit.point["feed"]
    q = search.data.first.T
    feels = np.abs(arm.gravity_torque(q)).max(0) > FELT_NM
    if not feels.any() or np.ptp(share[feels]) > ALIKE:
        return None
    return np.full(search.data.joints, float(share[feels].mean()))


def effects_left_out(search: LoopSearch, fit: LoopFit, held: Collection[str] = NATIVE) -> list[str]:
    """Effects of a fit that a simulator which has those `held` lacks, with their joints."""
    out: list[str] = []
    for effect, joints in _not_held(search, fit, held):
        if effect != "controller.feed_forward" or compensation(search, fit) is None:
            out += [f"{effect} {search.arm.names[j]}" for j in joints] or [effect.replace("@", " ")]
    return sorted(out)


def export_fit(
    sim: SimModel, search: LoopSearch, fit: LoopFit, native: LoopFit, held: Collection[str] = NATIVE
) -> Exported:
    """MJCF of the native fit, which has the effects `held`, and the effects of the whole fit that it leaves out."""
    spec, left, plant = named_spec(sim), effects_left_out(search, fit, held), MovedModel(sim)
    point = {name: value.copy() for name, value in native.point.items()}
    for name in ("kp", "back_emf"):
        point[name][~plant.driven] = 0.0  # of an actuator that the file gets
    model = plant.changed({**point, "feed": np.full(sim.n, plant.compensated)})
    sprung = point["spring"] > 1e-9
    model.qpos_spring[plant.places[sprung]] = -point["offset"][sprung] / point["spring"][sprung]
    if (share := float(point["feed"][0])) != plant.compensated:
        model.body_gravcomp[plant.carried()] = share
    write_changes(spec, sim, model)
    for j in range(sim.n):
        _set_actuator(spec, plant, model, native, j)
    if any(actuator.delay > 0.0 for actuator in spec.actuators):
        spec.option.timestep = min(float(spec.option.timestep), STEP_S)
    spec.compile()
    head = "These effects are left out, since MJCF has no field for them (the other effects were fitted without them):"
    comment = xml_comment([head, *left]) if left else ""
    return Exported(comment + spec.to_xml(), tuple(left), fit=native)


def export_with_module(sim: SimModel, search: LoopSearch, fit: LoopFit) -> Exported | None:
    """MJCF that is to be used with a module for friction that MJCF cannot hold; None if there is no such friction."""
    if not {effect for effect, _ in present(search, fit)} & {*IN_MODULE}:
        return None
    return export_beside_module(sim, search, fit, native_fit(search, fit, WRITTEN))


def export_beside_module(sim: SimModel, search: LoopSearch, fit: LoopFit, native: LoopFit) -> Exported:
    """MJCF of a native fit, with the effects that a module applies beside it and those of the whole fit left out."""
    effects: list[JointEffect] = []
    for effect, joints in present(search, native):
        for j in joints if effect in IN_MODULE else ():
            pairs = zip(EFFECTS[effect].reported, EFFECTS[effect].parameters, strict=True)
            values = {called: float(native.point[name][j]) for called, name in pairs}
            effects.append((effect, sim.arm.names[j], values))
    return replace(export_fit(sim, search, fit, native, WRITTEN), effects=tuple(effects))


def _not_held(search: LoopSearch, fit: LoopFit, held: Collection[str]) -> list[Group]:
    return [group for group in present(search, fit) if id_of(group) not in held]


def _set_actuator(spec: Any, plant: MovedModel, model: Any, fit: LoopFit, j: int) -> None:
    """One position actuator at a joint: the model's own as it was changed, or a new one where there is none, several,
    or where only a PID one holds what was found."""
    import mujoco

    joint, i = spec.joints[plant.joints[j]].name, int(plant.actuator[j])
    old = [a for a in spec.actuators if a.target == joint and a.trntype == mujoco.mjtTrn.mjTRN_JOINT]
    point = {name: float(value[j]) for name, value in fit.point.items() if len(value) == plant.n}
    optional = {"ki": point["ki"] * point["gain"], "slewmax": point["slew"]}
    optional = {name: value for name, value in optional.items() if value > 0.0 and np.isfinite(value)}
    if kept := len(old) == 1 and bool(plant.driven[j]) and not optional and not plant.pid[j]:
        made = old[0]
        made.gainprm, made.biasprm, made.dynprm = (
            getattr(model, f"actuator_{name}")[i] for name in ("gainprm", "biasprm", "dynprm")
        )
        made.forcelimited, made.forcerange = int(model.actuator_forcelimited[i]), model.actuator_forcerange[i]
    else:
        name = old[0].name if old else f"position_{joint}"
        limited = [a.ctrlrange for a in old[:1] if a.ctrlrange[0] < a.ctrlrange[1]]
        for actuator in old:
            spec.delete(actuator)
        made = add_actuator(spec, name, joint)
        gains = {"kp": point["kp"] * point["gain"], "kv": point["back_emf"] + min(point["kv"], point["viscous"])}
        if optional:
            made.set_to_pid(**gains, ctrlspec=1, **optional)  # its only input is a position
        else:
            made.set_to_position(**gains)
        if limited:
            made.ctrllimited, made.ctrlrange = 1, limited[0]
        if np.isfinite(limit := point["limit"] * point["gain"]):
            made.forcelimited, made.forcerange = 1, [-limit, limit]
    if i >= 0 and model.actuator_ctrllimited[i]:
        made.ctrllimited, made.ctrlrange = 1, model.actuator_ctrlrange[i]
    if not kept or point["delay"] != plant.servo["delay"][j]:
        put_delay(made, point["delay"])
