"""Export of the corrected model (`--out-model`): MJCF, and a module for the effects that MJCF cannot hold."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.errors import BadInput
from sim_gap.better_model.corrected_model import add_to, compiled_copy, coupled_motors, spec_of, with_effects
from sim_gap.better_model.effects_module import joint_effects, module_path, module_text
from sim_gap.better_model.forward_effects import JointEffect
from sim_gap.better_model.native_drives import DRIVE, LONGEST_STEP_S, motors_of, put_drive
from sim_gap.better_model.urdf import URDF, urdf_of, xml_comment
from sim_gap.model.load import SimModel, linear_part, urdf_behind
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

HINGE = 3
"""MuJoCo's number of this type of joint."""


@dataclass(frozen=True)
class Written:
    """The text of a corrected model and of the module beside it."""

    xml: str
    module: str
    """Empty if MJCF holds every effect."""
    spec: Any
    """`mujoco.MjSpec` of the model."""
    lines: list[str]
    """A line per effect that MJCF cannot hold, and per link that is not as fitted."""
    effects: list[JointEffect]
    """Effects that the module holds."""


def model_files(
    sim: SimModel,
    estimate: EffectEstimate | None,
    name: str,
    terms: Sequence[Term] | None = None,
    number: int = 0,
    laws: Sequence[JointEffect] = (),
    spec: Any = None,
    mount: float = 0.0,
) -> Written:
    """The files of the model with the effects of an estimate, or with some of its terms; `name` is the MJCF's.

    A body that only some recordings have is left out, except for the one with this `number`, in which it is turned by
    `mount` [rad]. `laws` are torques without a known cause. `spec` is the nominal model's if it has been read before;
    it is copied.
    """
    chosen = () if estimate is None else estimate.terms if terms is None else tuple(terms)
    spec = spec_of(sim) if spec is None else compiled_copy(spec)
    corrected = with_effects(sim, estimate, chosen, number, mount)
    for body in list(spec.bodies)[1:]:
        _set_inertial(body, corrected.model)
    for joint in spec.joints:
        _set_joint(joint, corrected.model, spec.compiler.degree)
    add_to(spec, coupled_motors(sim, estimate, chosen))
    motors, drives = motors_of(spec), _drives(sim, estimate, chosen)
    for joint, drive in drives.items():
        if joint in motors:
            put_drive(motors[joint], drive)
    if any("actuator.delay" in drive and joint in motors for joint, drive in drives.items()):
        spec.option.timestep = min(float(spec.option.timestep), LONGEST_STEP_S)
    spec.option.gravity = corrected.model.opt.gravity
    spec.compile()
    left = [t for t in corrected.not_held if t.effect not in DRIVE or sim.arm.names[t.place] not in motors]
    lines = [] if estimate is None else [_line(sim, estimate, term) for term in left]
    lines += [
        f"{name}: no body can have the fitted inertia of its link, so the file has the nearest possible inertia"
        for name in corrected.changed
    ]
    lines += [f"{law} {joint}: a torque without a known cause" for law, joint, _ in laws]
    module = module_path(Path(name)).name
    comment = xml_comment([f"Effects that MJCF cannot hold ({module} applies them):", *lines]) if lines else ""
    effects = [] if estimate is None else joint_effects(sim, estimate, corrected.not_held, corrected.held)
    effects += laws
    source = module_text(sim, effects, name) if effects else ""
    return Written(comment + spec.to_xml(), source, spec, lines, effects)


def write_model(
    sim: SimModel, estimate: EffectEstimate | None, path: Path, laws: Sequence[JointEffect] = ()
) -> list[str]:
    """Write the model with the effects as MJCF, or as URDF if the path ends so, and beside it a module for the rest.

    The module has the effects that MJCF cannot hold, and laws. Returns a line per effect that the file cannot hold; it
    lists them in a comment. A module of an earlier model of that name is removed if there is none now. Raises BadInput
    if the nominal model did not come from a file or a file cannot be written.
    """
    files = model_files(sim, estimate, path.name, laws=laws)
    text, lines = files.xml, files.lines
    if path.suffix == URDF:
        text, lines = urdf_of(files.spec.compile(), urdf_behind(sim.path), lines)
    try:
        write_whole(path, text)
        module = module_path(path)
        if files.module:
            write_whole(module, files.module)
        else:
            module.unlink(missing_ok=True)
    except OSError as error:
        raise BadInput(f"{error.filename}: cannot be written: {error.strerror}") from None
    return lines


def _drives(sim: SimModel, estimate: EffectEstimate | None, terms: Sequence[Term]) -> dict[str, dict[str, float]]:
    """Found values of the drives, joint → effect → value."""
    out: dict[str, dict[str, float]] = {}
    for term in terms:
        if estimate is not None and term.effect in DRIVE:
            value = estimate.parameters(term)[DRIVE[term.effect]].value
            out.setdefault(sim.arm.names[term.place], {})[term.effect] = value
    return out


def _line(sim: SimModel, estimate: EffectEstimate, term: Term) -> str:
    values = estimate.parameters(term)
    where = f"in recording {', '.join(map(str, term.bound))}" if term.bound else sim.arm.names[term.place]
    listed = (f"{name} {v.value:.6g}" + (f" {v.unit}" if v.unit != "1" else "") for name, v in values.items())
    return f"{term.effect} {where} " + ", ".join(listed)


def _set_inertial(body: Any, model: Any) -> None:
    i = body.id
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat = float(model.body_mass[i]), model.body_ipos[i], model.body_iquat[i]
    body.inertia = model.body_inertia[i]
    body.fullinertia = [np.nan] * 6


def _set_joint(joint: Any, model: Any, degrees: bool) -> None:
    """Give a joint of a file what the compiled one has; angles in the file's unit."""
    dof, adr = model.jnt_dofadr[joint.id], model.jnt_qposadr[joint.id]
    joint.frictionloss, joint.armature = float(model.dof_frictionloss[dof]), float(model.dof_armature[dof])
    joint.damping[0] = float(linear_part(model.dof_damping, model.nv)[dof])
    joint.stiffness[0] = float(linear_part(model.jnt_stiffness, model.njnt)[joint.id])
    unit = float(np.degrees(1.0)) if degrees and model.jnt_type[joint.id] == HINGE else 1.0
    joint.springref, zero = unit * float(model.qpos_spring[adr]), unit * float(model.qpos0[adr])
    if not np.isclose(zero, joint.ref, rtol=1e-9, atol=1e-12):
        joint.ref = zero
        joint.range = unit * model.jnt_range[joint.id] if model.jnt_limited[joint.id] else joint.range
