"""The simulation model with the fitted effects put in, as far as a MuJoCo model can hold them."""

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlink.errors import BadInput
from sim_gap.effects.base import across
from sim_gap.estimate import Estimate
from sim_gap.model import SimModel
from sim_gap.normal import Term
from sim_gap.rigid import Array, inertial_of

HELD = {
    "friction.coulomb": "joint frictionloss",
    "friction.viscous": "joint damping",
    "actuator.rotor_inertia": "joint armature",
    "transmission.spring": "joint stiffness and springref",
    "link.mass_moment": "body inertial",
    "link.inertia": "body inertial",
    "link.payload": "body inertial",
    "base.tilt": "option gravity",
}
"""Effects that a MuJoCo model holds, and where."""
SMALLEST_INERTIA = 1e-6


@dataclass(frozen=True)
class Closed:
    """A model with effects added."""

    model: Any
    """`mujoco.MjModel`."""
    held: tuple[Term, ...]
    not_held: tuple[Term, ...]
    """Terms that MJCF cannot express."""


def with_effects(sim: SimModel, estimate: Estimate | None) -> Closed:
    """A copy of the compiled model with the estimate's effects in it."""
    model = copy.copy(sim.mujoco_model)
    if estimate is None:
        return Closed(model, (), ())
    held = tuple(term for term in estimate.terms if term.effect in HELD and not term.bound)
    for term in held:
        c, joint = estimate.of(term), sim.joints[-1 if term.effect == "link.payload" else term.place]
        if term.effect == "link.mass_moment":
            body = model.jnt_bodyid[joint]
            model.body_ipos[body] += c / model.body_mass[body]
        elif term.effect == "link.inertia":
            _body(model, joint, np.concatenate([np.zeros(4), c]))
        elif term.effect == "link.payload":
            weighed = any(t.effect == "link.inertia" and t.place == sim.n - 1 for t in held)
            _body(model, joint, np.concatenate([c, np.zeros(6)]) if weighed else _point(c))
        elif term.effect == "base.tilt":
            turns = [-np.cross(axis, sim.arm.gravity) for axis in across(sim.arm.gravity)]
            model.opt.gravity[:] += np.stack(turns, axis=-1) @ c
        else:
            _joint(model, joint, term.effect, c)
    return Closed(model, held, tuple(term for term in estimate.terms if term not in held))


def _point(c: Array) -> Array:
    """Ten parameters of a point mass from its mass and first moment."""
    return inertial_of(float(c[0]), c[1:] / float(c[0]), np.zeros((3, 3)))


def _joint(model: Any, joint: int, effect: str, c: Array) -> None:
    dof, adr = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    if effect == "friction.coulomb":
        model.dof_frictionloss[dof] += c[0]
    elif effect == "friction.viscous":
        np.reshape(model.dof_damping, (model.nv, -1))[dof, 0] += c[0]
    elif effect == "actuator.rotor_inertia":
        model.dof_armature[dof] += c[0]
    else:
        stiffness = np.reshape(model.jnt_stiffness, (model.njnt, -1))
        total = stiffness[joint, 0] + c[0]
        model.qpos_spring[adr] = (stiffness[joint, 0] * model.qpos_spring[adr] - c[1]) / total
        stiffness[joint, 0] = total


def _body(model: Any, joint: int, added: Array) -> None:
    """Add inertial parameters, about the joint's anchor in the body's frame, to the body that the joint moves."""
    import mujoco

    body, anchor = model.jnt_bodyid[joint], model.jnt_pos[joint]
    spin = np.zeros(9)
    mujoco.mju_quat2Mat(spin, model.body_iquat[body])
    turn = spin.reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
    total = inertial_of(float(model.body_mass[body]), model.body_ipos[body] - anchor, inertia) + added
    mass, centre, about = split(total)
    values, axes = np.linalg.eigh(about)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_ipos[body] = mass, anchor + centre
    model.body_inertia[body] = possible(values)
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())


def possible(principal: Array) -> Array:
    """Principal moments of inertia that some distribution of mass has (none exceeds the other two together), (3,)."""
    spread = np.maximum(0.5 * principal.sum() - principal, SMALLEST_INERTIA)
    return np.asarray(spread.sum() - spread)


def split(inertial: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass and inertia about it (3, 3) from ten parameters about the origin."""
    mass = max(float(inertial[0]), 1e-6)
    centre = inertial[1:4] / mass
    about = inertial[4:][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    return mass, centre, about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))


def write_model(sim: SimModel, estimate: Estimate | None, path: Path) -> list[str]:
    """Write the model with the effects as MJCF; returns a line per effect that MJCF cannot hold, also put in a comment.

    Raises BadInput where the nominal model did not come from an MJCF or URDF file, or the file cannot be written.
    """
    import mujoco

    if sim.path is None or sim.path.suffix in (".yaml", ".yml"):
        raise BadInput(f"--out-model: {sim.path or 'the model'} is not MJCF or URDF: give such a file with --sim")
    closed = with_effects(sim, estimate)
    spec = mujoco.MjSpec.from_file(str(sim.path))
    spec.compile()  # numbers the elements
    for body in list(spec.bodies)[1:]:
        _set_inertial(body, closed.model)
    for joint in spec.joints:
        _set_joint(joint, closed.model)
    gains = _gains(sim, estimate)
    driven = {actuator.target for actuator in spec.actuators}
    for actuator in spec.actuators:
        actuator.gear = [gains.get(actuator.target, 1.0) * actuator.gear[0], *actuator.gear[1:]]
    spec.option.gravity = closed.model.opt.gravity
    spec.compile()
    lines = (
        []
        if estimate is None
        else [
            _line(sim, estimate, term)
            for term in closed.not_held
            if term.effect != "actuator.gain" or sim.arm.names[term.place] not in driven
        ]
    )
    text = "".join(f"  {line}\n" for line in lines)
    comment = f"<!-- Effects that MJCF cannot hold:\n{text}-->\n" if lines else ""
    try:
        path.write_text(comment + spec.to_xml(), encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from None
    return lines


def _gains(sim: SimModel, estimate: Estimate | None) -> dict[str, float]:
    """Torque made per torque commanded, by joint name."""
    terms = [] if estimate is None else [term for term in estimate.terms if term.effect == "actuator.gain"]
    return {sim.arm.names[t.place]: estimate.parameters(t)["gain"].value for t in terms if estimate is not None}


def _line(sim: SimModel, estimate: Estimate, term: Term) -> str:
    values = estimate.parameters(term)
    where = f"in recording {term.bound}" if term.bound else sim.arm.names[term.place]
    return f"{term.effect} {where} " + ", ".join(f"{k} {v.value:.6g} {v.unit}" for k, v in values.items())


def _set_inertial(body: Any, model: Any) -> None:
    i = body.id
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat = float(model.body_mass[i]), model.body_ipos[i], model.body_iquat[i]
    body.inertia = model.body_inertia[i]
    body.fullinertia = [np.nan] * 6


def _set_joint(joint: Any, model: Any) -> None:
    dof, adr = model.jnt_dofadr[joint.id], model.jnt_qposadr[joint.id]
    joint.frictionloss, joint.armature = float(model.dof_frictionloss[dof]), float(model.dof_armature[dof])
    joint.damping[0] = float(np.reshape(model.dof_damping, (model.nv, -1))[dof, 0])
    joint.stiffness[0] = float(np.reshape(model.jnt_stiffness, (model.njnt, -1))[joint.id, 0])
    joint.springref = float(model.qpos_spring[adr])
