"""Joints of a URDF or MJCF model, and which of them are the arm.

Kind, limits, torque and speed are known as far as the model states them. The arm is the longest chain of driven
revolute joints, without its gripper.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from gcomp.arm.load import compile_model
from gcomp.arm.model_file import HAND, coupled_joints, parse_xml, upwards

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


OF_A_HAND = "belongs to the hand, according to its name"
"""Why a joint that grasps is set aside."""


@dataclass(frozen=True)
class Chain:
    """The joints of an arm, base to tip."""

    joints: tuple[ModelJoint, ...]
    aside: tuple[tuple[str, str], ...]
    """(Joint, why it is not a joint of the arm); each keeps the model's position."""
    base: str | None = None
    """Body that carries it; None for the world."""

    @property
    def tip(self) -> str:
        return self.joints[-1].body


def find_chains(
    joints: Sequence[ModelJoint], path: Path, base: str | None = None, tip: str | None = None
) -> list[Chain]:
    """The chains that an arm may be, best first: more than one for a model of several arms.

    With `base` and `tip`, those that are carried by that body, and the one that ends in this. Raises BadInput
    where there is none, naming the joint in the way.
    """
    if base is not None and not any(base in joint.carried_by for joint in joints):
        carriers = ", ".join(dict.fromkeys(name for joint in joints for name in reversed(joint.carried_by)))
        raise BadInput(f"{path}: --base {base}: there is no such body that carries a joint; expected one of {carriers}")
    if tip is not None:
        ends = [place for place, joint in enumerate(joints) if joint.body == tip]
        if not ends:
            moving = ", ".join(dict.fromkeys(joint.body for joint in joints))
            raise BadInput(f"{path}: --tip {tip}: no moving body has this name; the moving bodies are {moving}")
        way = _after(joints, [*joints[ends[-1]].parents, ends[-1]], base)
        if not way:
            raise BadInput(f"{path}: --base {base} --tip {tip}: there is no revolute joint between these bodies")
        return [_chain(joints, way, path, base)]
    inner = {parent for joint in joints for parent in joint.parents}
    ways = []
    for leaf in (place for place in range(len(joints)) if place not in inner):
        way = _after(joints, [*joints[leaf].parents, leaf], base)
        whole = way
        while way and _aside(joints[way[-1]]):
            way = way[:-1]
        if not way and all(_aside(joints[place]) == OF_A_HAND for place in whole):
            way = whole  # a model of nothing but a finger is the arm itself
        if way and way not in ways:
            ways.append(way)
    if not ways:
        reasons = "; ".join(f"{joint.name} {_aside(joint)}" for joint in joints)
        raise BadInput(f"{path}: none of the joints of this model belongs to an arm: {reasons}")
    longest = max(map(len, ways))
    return [_chain(joints, way, path, base) for way in ways if len(way) == longest]


def _after(joints: Sequence[ModelJoint], way: list[int], base: str | None) -> list[int]:
    """Those of a way that `base` carries and that are not locked, from the first revolute one on.

    What carries the whole arm, such as a lift or a floating base, may be anywhere: it changes no joint's gravity.
    """
    free = [place for place in way if joints[place].locked is None]
    carried = [place for place in free if base is None or base in joints[place].carried_by]
    return list(dropwhile(lambda place: joints[place].kind in ("prismatic", "free"), carried))


def _aside(joint: ModelJoint) -> str | None:
    """Why a joint at the end of a chain is not one of the arm's, or None."""
    if joint.locked is not None:
        return f"is locked at {joint.locked:g}"
    if joint.kind != "revolute":
        return f"is {joint.kind}"
    if joint.partner is not None:
        return f"moves together with {joint.partner}"
    return OF_A_HAND if HAND.search(joint.name) else None


def _chain(joints: Sequence[ModelJoint], way: list[int], path: Path, base: str | None) -> Chain:
    chain = [joints[place] for place in way]
    carriers = [joints[place] for place in chain[0].parents if joints[place].locked is None]
    if base is None and carriers:
        base = carriers[-1].body
    for number, joint in enumerate(chain, start=1):
        if joint.kind != "revolute":
            raise BadInput(
                f"{path}: joint {joint.name or number} is {joint.kind} and lies between the base and the arm: begin "
                f"the arm after this joint (--base {joint.body}), or lock the joint (--lock {joint.name}:POSITION)"
            )
        if not joint.name:
            raise BadInput(
                f"{path}: joint {number} of the chain (body {joint.body!r}) has no name: name this joint in the model"
            )
    others = [joint for place, joint in enumerate(joints) if place not in way]
    aside = tuple((joint.name, _aside(joint) or "is off the chain to the tip") for joint in others)
    if aside and not chain[-1].body:
        raise BadInput(
            f"{path}: the body of joint {chain[-1].name} has no name: name this body, so that the chain can end there"
        )
    return Chain(tuple(chain), aside, base)
