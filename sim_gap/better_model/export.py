"""The simulation model corrected by the fitted effects as MJCF, and a module for the effects that MJCF cannot hold."""

import copy
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.content.atomic_file import write_whole, writing
from calib.arm.model_files import URDF, urdf_of, xml_comment
from gcomp.arm.inertials import body_parameters, fixed_body_parameters, pseudo_inertia, set_body, write_bodies
from gcomp.arm.model_file import linear_part, links_of_bodies
from gcomp.arm.rigid_body import CREEP
from gcomp.arrays import Array
from sim_gap.better_model import forward_effects
from sim_gap.better_model.forward_effects import STEP_S, JointEffect
from sim_gap.better_model.native_drives import DRIVE, motors_of, put_drive
from sim_gap.effects.link import mount_matrix, tilt_gravity
from sim_gap.effects.torque import GRADUAL, is_gradual
from sim_gap.model.load import SimModel, named_spec, urdf_behind
from sim_gap.model.solver_friction import solver_parameters
from sim_gap.search.column_store import inertial_change
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term


def add_motors(spec: Any, sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term]) -> None:
    """Add the motors that turn with two joints, by q_joint + lever·q_other, and so load both."""
    coupled = [term for term in terms if term.effect == "transmission.coupling"]
    for number, term in enumerate(coupled, start=1):
        joint, other = (sim.arm.names[place] for place in (term.place, int(term.shape[0]) - 1))
        tendon = spec.add_tendon(name=f"motor_{number}_of_{joint}_and_{other}")
        tendon.wrap_joint(joint, 1.0)
        tendon.wrap_joint(other, term.shape[1])
        tendon.armature, tendon.frictionloss, tendon.damping[0] = estimate.of(term).tolist()


HELD = {
    "friction.coulomb": "joint frictionloss",
    "friction.viscous": "joint damping",
    "actuator.rotor_inertia": "joint armature",
    "transmission.spring": "joint stiffness and springref",
    "transmission.coupling": "fixed tendon",
    "link.mass_moment": "body inertial",
    "link.inertia": "body inertial",
    "link.payload": "body inertial",
    "base.tilt": "option gravity",
    "position.offset": "joint ref, and range and springref with it",
}
"""Effects that a MuJoCo model can hold, and the element that holds them."""
OF_READING = ("position.gain", "position.eccentricity")
"""Errors of a reading that a MuJoCo model cannot hold; an offset beside them is left to the module, too."""


@dataclass(frozen=True)
class CorrectedModel:
    model: Any
    """`mujoco.MjModel`."""
    held: tuple[Term, ...]
    not_held: tuple[Term, ...]
    """Terms that MJCF cannot express."""
    changed: tuple[str, ...] = ()
    """Joints whose link is not the one that was fitted, which cannot exist, but one close to it."""


def with_effects(
    sim: SimModel,
    estimate: EffectEstimate,
    terms: Sequence[Term] | None = None,
    number: int = 0,
    mount: float = 0.0,
) -> CorrectedModel:
    """A copy of the compiled model with the estimate's effects in it, or with some of its terms.

    A body that only some recordings have is left out, except for the one with this `number`, in which it is turned by
    `mount` about the last joint's axis [rad].
    """
    chosen = estimate.terms if terms is None else tuple(terms)
    model = copy.copy(sim.mujoco_model)
    if sim.path is not None and any(term.effect == "transmission.coupling" for term in chosen):
        spec = named_spec(sim)
        add_motors(spec, sim, estimate, chosen)
        model = spec.compile()
    bent = {term.place for term in chosen if term.effect in OF_READING}
    left_out = {
        *(term for term in chosen if term.effect == "transmission.coupling" and sim.path is None),
        *(term for term in chosen if term.effect == "position.offset" and term.place in bent),
    }
    held = tuple(term for term in chosen if term.effect in HELD and term.present(number) and term not in left_out)
    turn, inertial = mount_matrix(sim.arm.axis[-1], mount), sim.arm.inertial.copy()
    for term in held:
        body = term.effect == "link.payload"
        change = inertial_change(term, turn @ estimate.of(term) if body else estimate.of(term), inertial, number)
        if change is not None:
            inertial[sim.n - 1 if body else term.place] += change
    added = inertial - sim.arm.inertial
    moved = np.flatnonzero(np.any(added != 0.0, axis=1)).tolist()
    exact = [_set_link(model, sim.joints, link, added[link]) for link in moved]
    changed = tuple(sim.arm.names[link] for link, fine in zip(moved, exact, strict=True) if not fine)
    for term in held:
        c = estimate.of(term)
        if term.effect == "base.tilt":
            model.opt.gravity[:] = tilt_gravity(sim.arm.gravity, c)
        elif term.effect.split(".")[0] not in ("link", "position") and term.effect != "transmission.coupling":
            _joint(model, sim, term.place, term.effect, c, added=estimate.store.data.layout.motor is not None)
    for place, offset in offsets(estimate, held).items():  # as the sensor counts: stops and spring stay where they are
        joint = sim.joints[place]
        adr = model.jnt_qposadr[joint]
        model.qpos0[adr] -= offset
        model.jnt_range[joint] -= offset * bool(model.jnt_limited[joint])
        model.qpos_spring[adr] -= offset * bool(linear_part(model.jnt_stiffness, model.njnt)[joint])
    return CorrectedModel(model, held, tuple(term for term in chosen if term not in held), changed)


def _set_link(model: Any, joints: Sequence[int], link: int, added: Array) -> bool:
    """Add ten parameters to the body that a joint moves, or to it with all that is fixed to it if it alone could not
    exist (a gripper taken away); whether the result is what was wanted."""
    joint = joints[link]
    body, anchor = int(model.jnt_bodyid[joint]), model.jnt_pos[joint]
    total = body_parameters(model, body, anchor, np.eye(3)) + added
    if not may_exist(total):
        links, data = links_of_bodies(model, joints), mujoco.MjData(model)
        fixed = [other for other, own in enumerate(links) if own == links[body] and other != body]
        mujoco.mj_kinematics(model, data)
        beside = (fixed_body_parameters(model, data, other, body, anchor) for other in fixed)
        whole = total + sum(beside, np.zeros(10))
        if fixed and may_exist(whole):
            total = whole
            for other in fixed:  # nearly nothing, since MuJoCo takes no body without a mass
                model.body_mass[other], model.body_inertia[other] = 1e-9, 1e-9
    return set_body(model, body, anchor, total)


def may_exist(inertial: Array) -> bool:
    return bool(inertial[0] > 0.0 and np.linalg.eigvalsh(pseudo_inertia(inertial)).min() > 0.0)


def write_changes(spec: Any, sim: SimModel, model: Any) -> None:
    """Write what a copy of the compiled model has of the arm's joints and links into its file's specification: one way
    to a file for what torques and what positions have shown."""
    write_bodies(spec, sim.mujoco_model, model)
    for place, number in enumerate(sim.joints):
        joint, dof, adr = spec.joints[number], model.jnt_dofadr[number], model.jnt_qposadr[number]
        unit = float(np.degrees(1.0)) if joint.compiler.degree and not sim.arm.slides[place] else 1.0
        joint.frictionloss, joint.armature = float(model.dof_frictionloss[dof]), float(model.dof_armature[dof])
        joint.damping[0] = float(linear_part(model.dof_damping, model.nv)[dof])
        joint.stiffness[0] = float(linear_part(model.jnt_stiffness, model.njnt)[number])
        joint.springref, joint.ref = unit * float(model.qpos_spring[adr]), unit * float(model.qpos0[adr])
        joint.solref_friction, joint.solimp_friction = model.dof_solref[dof], model.dof_solimp[dof]
        joint.range = unit * model.jnt_range[number] if model.jnt_limited[number] else joint.range
        joint.actfrcrange = model.jnt_actfrcrange[number] if model.jnt_actfrclimited[number] else joint.actfrcrange
    spec.option.gravity = model.opt.gravity


def offsets(estimate: EffectEstimate, held: Sequence[Term]) -> dict[int, float]:
    """Offsets of the position sensors that a model holds, by the joint's place [rad]."""
    return {term.place: float(estimate.of(term)[0]) for term in held if term.effect == "position.offset"}


def _joint(model: Any, sim: SimModel, place: int, effect: str, c: Array, added: bool) -> None:
    """Give a joint friction, damping, armature or a spring; `added` to what it has of the first three, or if that is
    the motor's, which a sensor on the link does not read, as much at least. Friction creeps up to the speed to which
    that of the nominal model does; without friction there, it rests as that of a gear."""
    joint = sim.joints[place]
    dof, adr = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    terms = {
        "friction.coulomb": "dof_frictionloss",
        "friction.viscous": "dof_damping",
        "actuator.rotor_inertia": "dof_armature",
    }
    if effect in terms:
        values = linear_part(getattr(model, terms[effect]), model.nv)
        values[dof] = max(values[dof] + c[0], 0.0) if added else max(values[dof], c[0])
    else:
        stiffness = linear_part(model.jnt_stiffness, model.njnt)
        total = stiffness[joint] + c[0]
        model.qpos_spring[adr] = (stiffness[joint] * model.qpos_spring[adr] - c[1]) / total
        stiffness[joint] = total
    if effect == "friction.coulomb":
        friction, weight = float(model.dof_frictionloss[dof]), float(model.dof_invweight0[dof])
        model.dof_solref[dof], model.dof_solimp[dof] = solver_parameters(friction, float(sim.arm.creep[place]), weight)


# ---- its files


@dataclass(frozen=True)
class CorrectedText:
    xml: str
    lines: tuple[str, ...]
    """A line per effect that it cannot hold, and per link that is not as fitted."""
    effects: tuple[JointEffect, ...] = ()
    """Those that a module applies beside it."""
    spec: Any = None
    """`mujoco.MjSpec` of the model, if it may refer to files beside it."""


def model_files(
    sim: SimModel,
    estimate: EffectEstimate,
    name: str,
    terms: Sequence[Term] | None = None,
    number: int = 0,
    laws: Sequence[JointEffect] = (),
    spec: Any = None,
    mount: float = 0.0,
) -> CorrectedText:
    """The text of the model as `with_effects` makes it; `name` is the MJCF's. `laws` are torques without a known cause;
    `spec` is the nominal model's if it has been read before."""
    chosen = estimate.terms if terms is None else tuple(terms)
    if spec is None:
        spec = named_spec(sim)
    else:
        spec = spec.copy()
        spec.compile()  # which numbers its elements
    corrected = with_effects(sim, estimate, chosen, number, mount)
    write_changes(spec, sim, corrected.model)
    add_motors(spec, sim, estimate, chosen)
    motors, drives = motors_of(spec), _drives(sim, estimate, chosen)
    for joint, drive in drives.items():
        if joint in motors:
            put_drive(motors[joint], drive)
            if "actuator.delay" in drive:
                spec.option.timestep = min(float(spec.option.timestep), STEP_S)
    spec.compile()
    left = [t for t in corrected.not_held if t.effect not in DRIVE or sim.arm.names[t.place] not in motors]
    lines = [_line(sim, estimate, term) for term in left]
    lines += [
        f"{name}: no body can have the fitted inertia of its link, so the file has the nearest possible inertia"
        for name in corrected.changed
    ]
    lines += [f"{law} {joint}: a torque without a known cause" for law, joint, _ in laws]
    module = module_path(Path(name)).name
    comment = xml_comment([f"Effects that MJCF cannot represent ({module} applies them):", *lines]) if lines else ""
    effects = joint_effects(sim, estimate, corrected.not_held, corrected.held)
    return CorrectedText(comment + spec.to_xml(), tuple(lines), (*effects, *laws), spec)


def write_model(sim: SimModel, estimate: EffectEstimate, path: Path, laws: Sequence[JointEffect] = ()) -> list[str]:
    """Write the model with the effects, and beside it a module for those that MJCF cannot hold and for laws; a line for
    each of them. Raises BadInput if the nominal model did not come from a file, or as `write_files`."""
    files = model_files(sim, estimate, path.name, laws=laws)
    beside = {module_path(path): module_text(sim, files.effects, path.name) if files.effects else None}
    return write_files(path, sim, files.xml, files.spec.compile, files.lines, beside)


def write_files(
    path: Path,
    sim: SimModel,
    xml: str,
    compiled: Callable[[], Any],
    lines: Sequence[str],
    beside: Mapping[Path, str | None],
) -> list[str]:
    """Write a corrected model, its MJCF or if the path ends so URDF, and texts beside it; None removes a file of an
    earlier model. Returns a line for all that the file cannot hold, `lines` first. Raises BadInput."""
    if path.suffix == URDF:
        xml, lines = urdf_of(compiled(), urdf_behind(sim.path), lines)
    with writing(path):
        for file, text in {path: xml, **beside}.items():
            if text is None:
                file.unlink(missing_ok=True)
            else:
                write_whole(file, text)
    return list(lines)


def module_path(model: Path) -> Path:
    """Path of the module of a written model: `closed.xml` → `closed_effects.py`."""
    return model.with_name(f"{model.stem}_effects.py")


def joint_effects(
    sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term], held: Sequence[Term] = ()
) -> list[JointEffect]:
    """The terms in the module's form, beside a model with those `held`; without those present in one recording alone.

    Without a torque sensor, an offset of the motor's torque is torque lost. A ripple follows the position as the model
    has it: as it is read, if the model holds an offset of that.
    """
    out: list[JointEffect] = []
    zeros = offsets(estimate, held)
    for term in terms:
        if term.bound:
            continue
        values = {name: each.value for name, each in estimate.parameters(term).items()}
        if term.effect == "torque.offset" and estimate.store.data.layout.sensor is None:
            values = {"lost": values["offset"]}
        if term.effect == "torque.hysteresis" and is_gradual(term.shape):
            values["gradual"] = 1.0
        if term.effect == "transmission.ripple":
            values["phase"] += values["cycles"] * zeros.get(term.place, 0.0)
        out.append((term.effect, sim.arm.names[term.place], values))
    return out


def module_text(sim: SimModel, effects: Sequence[JointEffect], model: str) -> str:
    """Source of the module with the effects that the MJCF file `model` cannot hold; it imports none of ours."""
    rows = "".join(f"    {each!r},\n" for each in effects)
    text = Path(forward_effects.__file__).read_text(encoding="utf-8")
    values = {
        "from gcomp.arm.rigid_body import CREEP": f"CREEP = {CREEP}  # [rad/s], below which motion has no direction",
        "from gcomp.arrays import Array": "Array = np.ndarray",
        "from sim_gap.effects.torque import GRADUAL": f"GRADUAL = {GRADUAL}  # half widths of plays over their mean",
        'MODEL = ""': f"MODEL = {model!r}",
        "JOINTS: tuple[str, ...] = ()": f"JOINTS = {sim.arm.names!r}",
        "EFFECTS: tuple[JointEffect, ...] = ()": f"EFFECTS = (\n{rows})",
    }
    declared = "|".join(map(re.escape, values))  # in one pass: what is filled in is not searched
    return re.sub(f"^(?:{declared})$", lambda found: values[found[0]], text, flags=re.MULTILINE)


def _drives(sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term]) -> dict[str, dict[str, float]]:
    """Found values of the drives, joint → effect → value."""
    out: dict[str, dict[str, float]] = {}
    for term in terms:
        if term.effect in DRIVE:
            value = estimate.parameters(term)[DRIVE[term.effect]].value
            out.setdefault(sim.arm.names[term.place], {})[term.effect] = value
    return out


def _line(sim: SimModel, estimate: EffectEstimate, term: Term) -> str:
    values = estimate.parameters(term)
    where = f"in recording {', '.join(map(str, term.bound))}" if term.bound else sim.arm.names[term.place]
    listed = (f"{name} {v.value:.6g}" + (f" {v.unit}" if v.unit != "1" else "") for name, v in values.items())
    return f"{term.effect} {where} " + ", ".join(listed)
