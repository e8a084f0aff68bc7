"""The simulation model corrected by the fitted effects, as far as a MuJoCo model can hold them."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlink.errors import BadInput
from gcomp.arrays import Array
from sim_gap.better_model.coupled_motors import CoupledMotor, add_to, coupled_motors
from sim_gap.effects.base import across
from sim_gap.model.load import SimModel, read_spec
from sim_gap.model.rigid_body import inertial_of
from sim_gap.search.estimate import Estimate
from sim_gap.search.normal_equations import Term

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
}
"""Effects that a MuJoCo model can hold, and the element that holds them."""
SMALLEST_INERTIA = 1e-6


@dataclass(frozen=True)
class CorrectedModel:
    """A model with effects added."""

    model: Any
    """`mujoco.MjModel`."""
    held: tuple[Term, ...]
    not_held: tuple[Term, ...]
    """Terms that MJCF cannot express."""


def with_effects(sim: SimModel, estimate: Estimate | None) -> CorrectedModel:
    """A copy of the compiled model with the estimate's effects in it."""
    if estimate is None:
        return CorrectedModel(copy.copy(sim.mujoco_model), (), ())
    model, coupled = _base(sim, coupled_motors(sim, estimate))
    held = tuple(
        term
        for term in estimate.terms
        if term.effect in HELD and not term.bound and (coupled or term.effect != "transmission.coupling")
    )
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
        elif term.effect != "transmission.coupling":
            _joint(model, joint, term.effect, c)
    return CorrectedModel(model, held, tuple(term for term in estimate.terms if term not in held))


def _base(sim: SimModel, motors: list[CoupledMotor]) -> tuple[Any, bool]:
    """A copy of the nominal model with these motors, and whether it has them (only a model from a file can)."""
    if not motors or sim.path is None:
        return copy.copy(sim.mujoco_model), False
    spec = spec_of(sim)
    add_to(spec, motors)
    return spec.compile(), True


def spec_of(sim: SimModel) -> Any:
    """The nominal model's file as a `mujoco.MjSpec`, its elements numbered and its joints named.

    Raises BadInput if the model did not come from a file.
    """
    if sim.path is None:
        raise BadInput("--out-model: the model did not come from a file: give MJCF, URDF or an arm file with --sim")
    spec = read_spec(sim.path)
    spec.compile()
    for name, joint in zip(sim.arm.names, sim.joints, strict=True):
        spec.joints[joint].name = spec.joints[joint].name or name
    return spec


def _point(c: Array) -> Array:
    """Ten inertial parameters of a point mass from its mass and first moment."""
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
    """Add inertial parameters, about the joint's anchor and in the body's frame, to the body that the joint moves."""
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
    """The closest physical principal moments of inertia (none exceeds the sum of the other two), (3,)."""
    spread = np.maximum(0.5 * principal.sum() - principal, SMALLEST_INERTIA)
    return np.asarray(spread.sum() - spread)


def split(inertial: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass and inertia about it (3, 3) from ten inertial parameters about the origin."""
    mass = max(float(inertial[0]), 1e-6)
    centre = inertial[1:4] / mass
    about = inertial[4:][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    return mass, centre, about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
