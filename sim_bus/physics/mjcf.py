"""The arm as a MuJoCo model: one body per link in the bar frame, joint ranges as mechanical stops."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from armlink.arm_file import ArmFile
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from armlink.model_file import add_actuator, read_model
from sim_bus.effects.state import Imperfections
from sim_bus.physics.transmission import rotor_name, tendon_name
from sim_bus.sim_section import LinkBody, SimSection, sim_section

STOP_IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)
FRICTION_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Solver impedance, close enough to 1 that creep under stiction is a few µrad/s."""
MOST_DAMPING = 0.5
"""Share of a drive's largest torque that a model's viscous friction may take at the largest velocity."""
TINY_INERTIA = 1e-9
DEGREE = np.pi / 180


@dataclass(frozen=True)
class BuiltModel:
    """A compiled model, with the body and degree of freedom of each joint from base to tip."""

    model: Any
    """mujoco.MjModel."""
    bodies: tuple[int, ...]
    """Bodies of the links, base to tip."""
    payload_body: int
    """Body in the last link's bar frame for an attached mass; almost massless without one."""
    spec: Any
    """mujoco.MjSpec of the model."""


def build_model(arm: ArmFile, state: Imperfections) -> BuiltModel:
    """The arm's chain as a compiled model with a motor per joint, with transmissions by `state`.

    Raises BadInput where a model file does not fit.
    """
    section = sim_section(arm)
    spec = _from_model(arm, section) if arm.kinematics.model is not None else _from_denavit_hartenberg(arm, section)
    _set_options(spec, arm, section)
    joints = [spec.joint(name) for name in arm.joint_names]
    for joint in joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # torque ends where the arm file's drives end
        joint.solref_limit = [max(section.stops.time_constant, 2 * section.step), 1.0]
        joint.solimp_limit = STOP_IMPEDANCE
        _set_friction(joint, section)
    for place, joint in enumerate(joints):
        target, kind = _add_gear(spec, place, [each.name for each in joints], state, section)
        motor = add_actuator(spec, f"motor {joint.name}", target, kind)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_AFFINE, mujoco.mjtBias.mjBIAS_AFFINE
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcerange = [-1e9, 1e9]
    last = joints[-1].parent
    payload = last.add_body(name="payload", mass=TINY_INERTIA, inertia=[TINY_INERTIA] * 3, explicitinertial=True)
    assert payload is not None
    spec.add_exclude(bodyname1="payload", bodyname2=last.name)  # who is named there stays a body of its own
    try:
        with memory_budget(arm.path if arm.model_path is None else arm.model_path):
            model = spec.compile()
    except (ValueError, RuntimeError) as error:
        raise BadInput(f"{arm.path}: the simulated arm cannot be built: {error}") from None
    bodies = tuple(int(model.joint(name).bodyid[0]) for name in arm.joint_names)
    return BuiltModel(model, bodies, int(model.body("payload").id), spec)


def _from_denavit_hartenberg(arm: ArmFile, section: SimSection) -> Any:
    spec = mujoco.MjSpec()
    spec.compiler.degree = spec.compiler.balanceinertia = False
    body, position, twist = spec.worldbody, [0.0, 0.0, 0.0], 0.0
    assert section.links is not None
    for row, link in zip(arm.kinematics.joints, section.links, strict=True):
        body = body.add_body(name=row.name, pos=position, quat=_twist_then_turn(twist, row.theta_offset))
        body.add_joint(name=row.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], range=[row.lower, row.upper])
        _set_inertial(body, link)
        position, twist = [row.a, 0.0, row.d], row.alpha
    return spec


def _from_model(arm: ArmFile, section: SimSection) -> Any:
    """The model file's chain, other joints frozen, without contacts and actuators."""
    path = arm.model_path
    assert path is not None
    spec = read_model(path, arm.kinematics.locked).spec
    names = set(arm.joint_names)
    missing = names - {joint.name for joint in spec.joints}
    if missing or not names:
        raise BadInput(f"{path}: the model has no joint {', '.join(sorted(missing)) or 'named in link.joints'}")
    for unwanted in (*spec.actuators, *spec.sensors, *spec.equalities, *spec.tendons, *spec.keys):
        spec.delete(unwanted)
    for joint in spec.joints:
        if joint.name not in names:
            spec.delete(joint)
    drives = {} if arm.link is None else {drive.name: drive for drive in arm.link.joints}
    for joint in spec.joints:
        drive = drives.get(joint.name)
        if drive is not None and np.sum(joint.damping) * drive.max_velocity > MOST_DAMPING * drive.max_torque:
            joint.damping = 0.0 * joint.damping  # a simulator's stabiliser: it would leave the drive too little to lift
        if joint.name in arm.kinematics.stops:
            joint.range = np.array(arm.kinematics.stops[joint.name]) / (DEGREE if joint.compiler.degree else 1.0)
        if joint.type != mujoco.mjtJoint.mjJNT_HINGE or joint.range[0] >= joint.range[1]:
            raise BadInput(f"{path}: joint {joint.name} must be a hinge with a range")
    if section.links is not None:
        for name, link in zip(arm.joint_names, section.links, strict=True):
            _set_inertial(spec.joint(name).parent, link)
    return spec


def _set_options(spec: Any, arm: ArmFile, section: SimSection) -> None:
    option = spec.option
    option.gravity = arm.kinematics.gravity
    option.timestep = section.step
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.ls_iterations = 50, 50
    option.tolerance, option.ls_tolerance = 1e-12, 1e-6  # looser tolerances make stiction chatter
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.compiler.fusestatic = True  # legs and a head that stand still cost as much as links that move


def _set_friction(what: Any, section: SimSection) -> None:
    what.solref_friction = [2 * section.step, 1.0]
    what.solimp_friction = FRICTION_IMPEDANCE
    what.frictionloss = 1.0  # so that every motor has a constraint row; the plant sets the level


def _add_gear(spec: Any, place: int, names: list[str], state: Imperfections, section: SimSection) -> tuple[str, Any]:
    """Add the transmission between a joint and its motor; returns name and kind of the driven element."""
    name, of_joint, of_tendon = names[place], mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON
    others = [(names[other], state.coupling[place, other]) for other in np.flatnonzero(state.coupling[place])]
    if state.soft[place]:
        rotor = rotor_name(name)
        body = spec.worldbody.add_body(name=rotor, mass=TINY_INERTIA, inertia=[TINY_INERTIA] * 3, explicitinertial=True)
        joint = body.add_joint(name=rotor, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        _without_defaults(joint)
        _set_friction(joint, section)
        if not others:
            return rotor, of_joint
        _add_sum(spec, f"encoder {name}", [(rotor, 1.0), *((other, -turn) for other, turn in others)])
        return f"encoder {name}", of_tendon
    if others:
        _set_friction(_add_sum(spec, tendon_name(name), [(name, 1.0), *others]), section)
    return name, of_joint


def _add_sum(spec: Any, name: str, parts: list[tuple[str, float]]) -> Any:
    """A weighted sum of joint angles."""
    tendon = spec.add_tendon(name=name)
    _without_defaults(tendon)
    for joint, weight in parts:
        tendon.wrap_joint(joint, weight)
    return tendon


def _without_defaults(what: Any) -> None:
    """Take from a joint or a tendon what the defaults of the model's file gave it."""
    what.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    what.stiffness, what.damping, what.armature = 0.0 * what.stiffness, 0.0 * what.damping, 0.0


def _set_inertial(body: Any, link: LinkBody) -> None:
    body.explicitinertial = True
    body.mass, body.ipos = link.mass, link.com
    body.fullinertia = [*link.inertia, 0.0, 0.0, 0.0][:6]


def _twist_then_turn(twist: float, turn: float) -> list[float]:
    """Quaternion of Rx(twist)·Rz(turn)."""
    quaternion = np.zeros(4)
    about_x = np.array([np.cos(twist / 2), np.sin(twist / 2), 0.0, 0.0])
    about_z = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    mujoco.mju_mulQuat(quaternion, about_x, about_z)
    return [float(value) for value in quaternion]
