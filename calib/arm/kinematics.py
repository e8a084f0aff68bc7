"""The arm file's kinematics as gcomp's arm, whether given as Denavit-Hartenberg rows or as a model file."""

from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from calib.arm.tool import tool_moments
from gcomp.arm.arm import Arm, bar_rotations
from gcomp.arm.load import ModelArm, PlacedChain, place_chain
from gcomp.arrays import Array
from gcomp.errors import GcompError


def gcomp_arm(arm_file: ArmFile) -> Arm:
    """The arm that gcomp computes with, joints in the arm file's order.

    Raises BadInput if a model file cannot be used or its joints are not those of the link section.
    """
    kinematics = arm_file.kinematics
    if arm_file.model_path is not None:
        return model_arm(arm_file).arm
    rows = kinematics.joints
    try:
        return Arm(
            names=tuple(row.name for row in rows),
            alpha=np.array([row.alpha for row in rows]),
            a=np.array([row.a for row in rows]),
            d=np.array([row.d for row in rows]),
            theta_offset=np.array([row.theta_offset for row in rows]),
            gravity=np.array(kinematics.gravity),
            lower=np.array([row.lower for row in rows]),
            upper=np.array([row.upper for row in rows]),
        )
    except GcompError as error:
        raise BadInput(f"{arm_file.path}: kinematics: {error}") from None


def frame_origins(arm: Arm, q: Array) -> Array:
    """Origins of all frames, base to tip (K, n + 1, 3) [m], at poses q (K, n) [rad]."""
    rotation = bar_rotations(arm, q)
    along = np.einsum("knij,nj->kni", rotation, arm.span)
    places = np.zeros((len(q), arm.n + 1, 3))
    places[:, 1:] = np.cumsum(along, axis=1)
    return places


def model_arm(arm_file: ArmFile, placed: PlacedChain | None = None) -> ModelArm:
    """The arm of the arm file's model file, with the mass moments of the model and the arm file's tool.

    `placed` is its chain where that is known already. Raises BadInput as gcomp_arm does.

    The arm file's gravity is in the model's world frame; without it the model's own is used.
    """
    model, kinematics = (placed or model_chain(arm_file)).arm, arm_file.kinematics
    if arm_file.link is not None and arm_file.joint_names != model.arm.names:
        raise BadInput(
            f"{arm_file.path}: link.joints are {list(arm_file.joint_names)}, but the chain of the model is "
            f"{list(model.arm.names)}: give link.joints the same names in the same order"
        )
    arm = _with_stops(arm_file, model.arm) if kinematics.stops else model.arm
    tool = 0.0 if arm_file.tool is None else arm_file.tool.mass
    mass = model.mass + np.append(np.zeros(arm.n - 1), tool)
    return replace(model, arm=arm, beta=model.beta + tool_moments(arm, arm_file.tool), mass=mass)


def model_chain(arm_file: ArmFile) -> PlacedChain:
    """The arm file's chain in its model, with the bodies of each link; raises BadInput."""
    path, kinematics = arm_file.model_path, arm_file.kinematics
    if path is None:
        raise BadInput(f"{arm_file.path}: key kinematics.model is missing: this command needs a URDF or MJCF file")
    gravity = kinematics.gravity if "gravity" in kinematics.model_fields_set else None
    ends = {"base": kinematics.base, "tip": kinematics.tip}
    try:
        with model_budget(path):
            return place_chain(path, **ends, gravity=gravity, locked=kinematics.locked)
    except GcompError as error:
        raise BadInput(f"{arm_file.path}: key kinematics.model: {error}") from None


def _with_stops(arm_file: ArmFile, arm: Arm) -> Arm:
    """The arm with the arm file's stops where it has any; raises BadInput."""
    stops = arm_file.kinematics.stops
    for name in stops:
        if name not in arm.names:
            known = ", ".join(arm.names)
            raise BadInput(
                f"{arm_file.path}: key kinematics.stops.{name}: there is no joint of this name; there are {known}"
            )
    limits = [stops.get(name, own) for name, *own in zip(arm.names, arm.lower, arm.upper, strict=True)]
    return replace(arm, lower=np.array([low for low, _ in limits]), upper=np.array([high for _, high in limits]))


@dataclass(frozen=True, eq=False)
class DriveLimits:
    """Stops, and what the drives are capable of; all (n,)."""

    lower: Array
    """[rad]"""
    upper: Array
    """[rad]"""
    rated: Array
    """[N·m]"""
    max_torque: Array
    """[N·m]"""
    speed: Array
    """[rad/s]"""

    @classmethod
    def of(cls, arm_file: ArmFile) -> "DriveLimits":
        kinematics, link = gcomp_arm(arm_file), arm_file.require_link()
        return cls(
            kinematics.lower,
            kinematics.upper,
            link.rated_torques,
            np.array([joint.max_torque for joint in link.joints]),
            np.array([joint.max_velocity for joint in link.joints]),
        )
