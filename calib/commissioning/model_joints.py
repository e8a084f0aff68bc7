"""Joints of a URDF or MJCF model: kind, limits, torque and speed as far as the model states them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from gcomp.arm.load import compile_model
from gcomp.arm.model_file import coupled_joints, parse_xml, upwards

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class ModelJoint:
    """One joint of a model; None is what the model does not state."""

    name: str
    body: str
    """Body that the joint moves."""
    kind: str
    """revolute, prismatic, ball or free."""
    limits: tuple[float, float] | None
    """[rad]"""
    effort: float | None
    """Largest torque [N·m]."""
    speed: float | None
    """[rad/s]"""
    partner: str | None
    """Another joint that it is coupled with: a mimic joint, or the one mimicked."""
    parents: tuple[int, ...]
    """Places of the joints between the base and this one, in the list of all."""
    carried_by: tuple[str, ...]
    """Bodies between the base and the one that it moves."""
    armature: float = 0.0
    """Rotor inertia at the joint [kg·m²]."""
    locked: float | None = None
    """Position [rad, m] at which something else than the arm's drives holds it; None: it is not held."""

    @property
    def has_stops(self) -> bool:
        """Whether its limits may be mechanical stops: those more than a turn apart are none."""
        return self.limits is not None and self.limits[1] - self.limits[0] <= 2 * np.pi

    @property
    def limits_in_words(self) -> str:
        return "no limits" if self.limits is None else "limits more than a turn apart"


def model_joints(
    path: Path, locked: Mapping[str, float] | None = None
) -> tuple[list[ModelJoint], tuple[float, float, float]]:
    """All joints of a model in its order, and gravity in its world frame [m/s²]; raises BadModel, BadInput.

    Those in `locked` are held at that position [rad, m].
    """
    import mujoco

    with model_budget(path):
        model = compile_model(path)
    kinds = {
        mujoco.mjtJoint.mjJNT_HINGE: "revolute",
        mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
        mujoco.mjtJoint.mjJNT_BALL: "ball",
    }
    coupled, speeds = coupled_joints(model), _urdf_speeds(path)
    joints: list[ModelJoint] = []
    of_body: dict[int, list[int]] = {}
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        carriers = upwards(model, body)
        parents = tuple(sorted(place for up in carriers for place in of_body.get(up, [])))
        of_body.setdefault(body, []).append(joint)
        name = model.joint(joint).name
        limits = tuple(map(float, model.jnt_range[joint])) if model.jnt_limited[joint] else None
        joints.append(
            ModelJoint(
                name=name,
                body=model.body(body).name,
                kind=kinds.get(mujoco.mjtJoint(model.jnt_type[joint]), "free"),
                limits=limits,  # type: ignore[arg-type]
                effort=_effort(model, joint),
                speed=speeds.get(name),
                partner=coupled.get(name),
                parents=parents,
                carried_by=tuple(model.body(up).name for up in carriers[1:]),
                armature=float(model.dof_armature[model.jnt_dofadr[joint]]),
                locked=(locked or {}).get(name),
            )
        )
    if not joints:
        raise BadInput(f"{path}: the model has no joint: give the URDF or MJCF of an arm")
    x, y, z = (float(value) for value in model.opt.gravity)
    return joints, (x, y, z)


def _effort(model: "mujoco.MjModel", joint: int) -> float | None:
    """Largest torque that joint and actuators allow [N·m], None where nothing limits it."""
    import mujoco

    bounds = []
    if model.jnt_actfrclimited[joint]:
        bounds.append(np.abs(model.jnt_actfrcrange[joint]).max())
    for actuator in range(model.nu):
        drives_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        if not drives_joint or model.actuator_trnid[actuator, 0] != joint:
            continue
        gear = abs(model.actuator_gear[actuator, 0])
        if model.actuator_forcelimited[actuator]:
            bounds.append(gear * np.abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_ctrllimited[actuator] and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE:
            gain = abs(model.actuator_gainprm[actuator, 0])
            bounds.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(bounds)) if bounds and min(bounds) > 0 else None


def _urdf_speeds(path: Path) -> dict[str, float]:
    """Velocity limits [rad/s] of a URDF's joints, which MuJoCo does not keep; none of an MJCF."""
    speeds = {}
    for joint in parse_xml(path.read_bytes()).findall("joint"):
        limit = joint.find("limit")
        try:
            speed = 0.0 if limit is None else float(limit.get("velocity", "0"))
        except ValueError:
            continue
        if speed > 0:
            speeds[joint.get("name", "")] = speed
    return speeds
