"""The arm file as what gcomp computes with: kinematics from rows or a model file, tool, and limits of the drives."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile, Tool, load_arm
from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from armlink.model_file import MODEL_SUFFIXES
from gcomp.arm.arm import Arm, bar_rotations
from gcomp.arm.load import ModelArm, PlacedChain, place_chain
from gcomp.arm.mass_moments import payload_columns
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
                f"{arm_file.path}: key kinematics.stops.{name}: there is no joint of this name; expected one of {known}"
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


def tool_moments(arm: Arm, tool: Tool | None) -> Array:
    """Mass moments that the tool adds (2n,) [kg·m]; equation (P) of docs/theory.md."""
    if tool is None:
        return np.zeros(2 * arm.n)
    at_origin, by_point = payload_columns(arm)
    return np.asarray(tool.mass * (at_origin + by_point @ np.array(tool.centre)))


def tool_covariance(arm: Arm, tool: Tool | None) -> Array:
    """Covariance of the mass moments that the tool adds (2n, 2n) [kg²·m²]."""
    if tool is None:
        return np.zeros((2 * arm.n, 2 * arm.n))
    at_origin, by_point = payload_columns(arm)
    of_mass = tool.mass_std * (at_origin + by_point @ np.array(tool.centre))
    of_centre = tool.mass * tool.centre_std * by_point
    return np.outer(of_mass, of_mass) + of_centre @ of_centre.T


def parse_tool(text: str) -> Tool | None:
    """`MASS,X,Y,Z` [kg, m], or `0` for none; raises BadInput."""
    try:
        mass, *centre = (float(part) for part in text.split(","))
    except ValueError:
        mass, centre = np.nan, []
    if mass == 0 and len(centre) in (0, 3):
        return None
    if not 0 < mass < np.inf or len(centre) != 3 or not np.isfinite(centre).all():
        raise BadInput(
            f"--tool {text}: expected MASS,X,Y,Z: mass [kg] and centre of mass [m] in the frame that turns with the "
            "last joint, or 0 for no tool"
        )
    return Tool(mass=mass, centre=(centre[0], centre[1], centre[2]))


def with_tool(arm_file: ArmFile, text: str | None) -> ArmFile:
    """The arm with the tool of an option `--tool`; without one as the file has it. Raises BadInput."""
    return arm_file if text is None else arm_file.model_copy(update={"tool": parse_tool(text)})


@dataclass(frozen=True, eq=False)
class StatedModel:
    """An arm, and the model file and the arm file behind it."""

    arm: Arm
    placed: PlacedChain | None
    """The chain in its model file; None for an arm of Denavit-Hartenberg rows."""
    path: Path | None
    """The model file."""
    beta: Array | None
    """Mass moments of the model file and the tool (2n,) [kg·m]; None without one."""
    arm_file: ArmFile | None = None


def stated_model(model: str, base: str | None = None, tip: str | None = None, tool: str | None = None) -> StatedModel:
    """Of a bundled arm, an arm file, or a URDF or MJCF file with the ends of its chain; raises BadInput, BadModel.

    `tool` is that of an option `--tool`; without one it is the arm file's.
    """
    path = Path(model)
    if path.suffix.lower() in MODEL_SUFFIXES:
        if not path.is_file():
            raise BadInput(f"there is no model file {model}: give the path of a URDF or MJCF file, or of an arm file")
        with model_budget(path):
            placed = place_chain(path, base=base, tip=tip)
        moments = tool_moments(placed.arm.arm, None if tool is None else parse_tool(tool))
        return StatedModel(placed.arm.arm, placed, path, placed.arm.beta + moments)
    if base is not None or tip is not None:
        raise BadInput("--base and --tip need a URDF or MJCF file; an arm file describes its chain under kinematics")
    arm_file = with_tool(load_arm(model), tool)
    if arm_file.model_path is None:
        return StatedModel(gcomp_arm(arm_file), None, None, None, arm_file)
    placed = model_chain(arm_file)
    found = model_arm(arm_file, placed)
    return StatedModel(found.arm, placed, arm_file.model_path, found.beta, arm_file)
