"""The simulation model corrected by the fitted effects, as far as a MuJoCo model can hold them."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gcomp.arm.inertials import body_parameters, fixed_body_parameters, pseudo_inertia, set_body, write_bodies
from gcomp.arm.model_file import linear_part
from gcomp.arrays import Array
from sim_gap.effects.link import mount_matrix, tilt_gravity
from sim_gap.model.load import SimModel, links_of_bodies, named_spec
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.estimate_signals import inertial_change
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
LEFT_KG = 1e-9
"""Mass and inertia left in a body whose inertials are counted to the body that it is fixed to."""


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
    model, coupled = _base(sim, estimate, chosen)
    bent = {term.place for term in chosen if term.effect in OF_READING}
    left_out = {
        *(term for term in chosen if term.effect == "transmission.coupling" and not coupled),
        *(term for term in chosen if term.effect == "position.offset" and term.place in bent),
    }
    held = tuple(term for term in chosen if term.effect in HELD and term.present(number) and term not in left_out)
    turn = mount_matrix(sim.arm.axis[-1], mount)
    links = [(term, turn @ estimate.of(term) if term.effect == "link.payload" else estimate.of(term)) for term in held]
    changed = _set_links(model, sim, links, number)
    for term in held:
        c, joint = estimate.of(term), sim.joints[term.place]
        if term.effect == "base.tilt":
            model.opt.gravity[:] = tilt_gravity(sim.arm.gravity, c)
        elif term.effect.split(".")[0] not in ("link", "position") and term.effect != "transmission.coupling":
            _joint(model, joint, term.effect, c, added=estimate.store.data.layout.motor is not None)
    for place, offset in offsets(estimate, held).items():
        _move_zero(model, sim.joints[place], offset)
    return CorrectedModel(model, held, tuple(term for term in chosen if term not in held), changed)


def _set_links(model: Any, sim: SimModel, terms: Sequence[tuple[Term, Array]], number: int) -> tuple[str, ...]:
    """Put the terms that change links into the model; the joints whose link could not be made as fitted."""
    inertial = sim.arm.inertial.copy()
    for term, c in terms:
        change = inertial_change(term, c, inertial, number)
        if change is not None:
            inertial[sim.n - 1 if term.effect == "link.payload" else term.place] += change
    moved = np.flatnonzero(np.any(inertial != sim.arm.inertial, axis=1)).tolist()
    exact = [_set_link(model, sim.joints, link, inertial[link] - sim.arm.inertial[link]) for link in moved]
    return tuple(sim.arm.names[link] for link, fine in zip(moved, exact, strict=True) if not fine)


def _set_link(model: Any, joints: Sequence[int], link: int, added: Array) -> bool:
    """Add ten parameters to the body that a joint moves, or to it with all that is fixed to it if it alone could not
    exist (a gripper taken away); whether the result is what was wanted."""
    import mujoco

    joint = joints[link]
    body, anchor = int(model.jnt_bodyid[joint]), model.jnt_pos[joint]
    total = body_parameters(model, body, anchor, np.eye(3)) + added
    if not may_exist(total):
        links, data = links_of_bodies(model, joints), mujoco.MjData(model)
        fixed = [other for other, own in enumerate(links) if own == link and other != body]
        mujoco.mj_kinematics(model, data)
        beside = (fixed_body_parameters(model, data, other, body, anchor) for other in fixed)
        whole = total + sum(beside, np.zeros(10))
        if fixed and may_exist(whole):
            total = whole
            for other in fixed:
                model.body_mass[other], model.body_inertia[other] = LEFT_KG, LEFT_KG
    return set_body(model, body, anchor, total)


def may_exist(inertial: Array) -> bool:
    return bool(inertial[0] > 0.0 and np.linalg.eigvalsh(pseudo_inertia(inertial)).min() > 0.0)


def _base(sim: SimModel, estimate: EffectEstimate, terms: Sequence[Term]) -> tuple[Any, bool]:
    """A copy of the nominal model with its coupled motors, and whether it has any (only a model from a file can)."""
    if sim.path is None or not any(term.effect == "transmission.coupling" for term in terms):
        return copy.copy(sim.mujoco_model), False
    spec = named_spec(sim)
    add_motors(spec, sim, estimate, terms)
    return spec.compile(), True


def write_changes(spec: Any, sim: SimModel, model: Any) -> None:
    """Write what a copy of the compiled model has of the arm's joints and links into its file's specification: one way
    to a file for what torques and what positions have shown."""
    write_bodies(spec, sim.mujoco_model, model)
    for number in sim.joints:
        joint, dof, adr = spec.joints[number], model.jnt_dofadr[number], model.jnt_qposadr[number]
        unit = float(np.degrees(1.0)) if joint.compiler.degree else 1.0
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


def _move_zero(model: Any, joint: int, offset: float) -> None:
    """Count the position of a joint as a sensor with this offset does: stops and spring stay where they are."""
    adr = model.jnt_qposadr[joint]
    model.qpos0[adr] -= offset
    if model.jnt_limited[joint]:
        model.jnt_range[joint] -= offset
    if linear_part(model.jnt_stiffness, model.njnt)[joint]:
        model.qpos_spring[adr] -= offset


def _joint(model: Any, joint: int, effect: str, c: Array, added: bool) -> None:
    """Give a joint friction, damping, armature or a spring; `added` to what it has of the first three, or if that is
    the motor's, which a sensor on the link does not read, as much at least."""
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
