"""Arms from URDF and MJCF files, read through MuJoCo and converted to Denavit-Hartenberg form."""

import logging
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arm.dh_rows import ArmGeometry, axes_to_arm
from gcomp.arm.inertials import body_parameters
from gcomp.arm.mass_moments import base_parameters
from gcomp.arm.model_file import NotXml, links_of_bodies, parse_xml, upwards
from gcomp.arrays import Array, as_array
from gcomp.errors import BadModel

if TYPE_CHECKING:
    import mujoco

log = logging.getLogger(__name__)
URDF_COMPILER = {"fusestatic": "false", "discardvisual": "true", "balanceinertia": "true"}
URDF_COMPILER |= {"boundmass": "1e-14", "boundinertia": "1e-14"}
"""MuJoCo refuses massless moving bodies, which are common in URDF files: they get a mass of no effect on gravity."""
INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True, eq=False)
class ModelArm:
    """An arm read from a model file, with the gravity of its own inertials."""

    arm: Arm
    beta: Array
    """Mass moments (2n,) of the model's inertials [kg·m]."""
    mass: Array
    """Masses (n,) of the links [kg]."""


def load_model(
    path: Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    gravity: ArrayLike | None = None,
    locked: Mapping[str, float] | None = None,
) -> ModelArm:
    """The serial arm of revolute joints in a URDF or MJCF file.

    The chain begins after body `base`, by default the world, and ends in body `tip`, by default the last body that
    moves. Joints off the chain are refused unless `tip` is given: then they keep the file's position, as do the joints
    that carry `base`. Joints in `locked` stay at that position [rad, m] and are none of the chain's. `gravity` (3,)
    [m/s²] in the model's world frame replaces the model's own. Raises BadModel, naming the joint, if the chain is not a
    serial arm of revolute joints.
    """
    return place_chain(path, base=base, tip=tip, gravity=gravity, locked=locked).arm


@dataclass(frozen=True, eq=False)
class PlacedChain:
    """The chain in MuJoCo's reference configuration."""

    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    arm: ModelArm
    geometry: ArmGeometry
    anchors: Array
    """A point on each joint's axis (n, 3), world frame [m]."""
    reference: Array
    """Joint positions (n,) of this configuration [rad]."""
    bodies: tuple[tuple[int, ...], ...]
    """Ids of the bodies that each link consists of, the one with the joint first."""
    joints: tuple[int, ...]
    """Ids of the chain's joints."""


def place_chain(
    path: Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    gravity: ArrayLike | None = None,
    locked: Mapping[str, float] | None = None,
) -> PlacedChain:
    """As load_model, with the bodies of each link; raises BadModel likewise."""
    model = compile_model(path)
    held = {_joint(model, name, path): position for name, position in (locked or {}).items()}
    return _place(model, _chain(model, path, base, tip, held), gravity, path, held)


def compile_model(path: Path) -> "mujoco.MjModel":
    """The file compiled by MuJoCo without the meshes that are not there, a URDF without any; raises BadModel.

    Gravity needs the inertials alone.
    """
    return compiled_spec(path)[1]


def compiled_spec(path: Path) -> "tuple[mujoco.MjSpec, mujoco.MjModel]":
    """The same with its specification, in which files have absolute paths."""
    import mujoco

    mujoco.set_mju_user_warning(log.info)
    try:
        root = parse_xml(path.read_bytes())
    except (NotXml, OSError) as error:
        raise BadModel(f"{path}: not a URDF or MJCF file: {error}") from None
    try:
        if root.tag == "robot":
            spec = mujoco.MjSpec.from_string(_plain_urdf(root))
        else:
            spec = mujoco.MjSpec.from_file(str(path))
            _drop_absent_meshes(spec, path.parent / spec.compiler.meshdir)
            for key in ("meshdir", "texturedir"):
                setattr(spec.compiler, key, str((path.parent / getattr(spec.compiler, key)).resolve()))
        return spec, spec.compile()
    except (ValueError, RuntimeError) as error:  # the latter where it gets no memory
        raise BadModel(f"{path}: MuJoCo refuses this file: {' '.join(str(error).split())}") from None


def _drop_absent_meshes(spec: "mujoco.MjSpec", folder: Path) -> None:
    for mesh in list(spec.meshes):
        if mesh.file and not isfile(folder / mesh.file):
            for geom in [each for each in spec.geoms if each.meshname == mesh.name]:
                spec.delete(geom)
            spec.delete(mesh)


def _plain_urdf(root: ET.Element) -> str:
    """The URDF with only links, joints and inertials, for MuJoCo's compiler."""
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    for own in root.findall("mujoco"):
        root.remove(own)
    for inertia in root.iter("inertia"):
        if _has_negative_moment(inertia):
            inertia.attrib.update(dict.fromkeys(INERTIA_KEYS, "0"))
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", URDF_COMPILER)
    return ET.tostring(root, encoding="unicode")


def _has_negative_moment(inertia: ET.Element) -> bool:
    """Whether a URDF's inertia has a negative principal moment, which MuJoCo refuses and gravity does not need."""
    try:
        xx, xy, xz, yy, yz, zz = (float(inertia.get(key, "0")) for key in INERTIA_KEYS)
    except ValueError:
        return False  # MuJoCo says what is wrong
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return bool(np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] < 0.0)


def _joint(model: "mujoco.MjModel", name: str, path: Path) -> int:
    """Id of a joint that is to be locked; raises BadModel."""
    import mujoco

    joint = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name))
    if joint < 0:
        names = ", ".join(model.joint(joint).name for joint in range(model.njnt))
        raise BadModel(f"{path}: there is no joint {name!r} to lock; the joints are {names}")
    return joint


def _chain(
    model: "mujoco.MjModel", path: Path, base: str | None, tip: str | None, locked: Mapping[int, float]
) -> list[int]:
    """Ids of the chain's joints, base to tip; every one a hinge."""
    import mujoco

    joints = [joint for joint in range(model.njnt) if joint not in locked]
    if not joints:
        raise BadModel(f"{path}: the model has no joint, but an arm has at least one revolute joint")
    last = int(model.jnt_bodyid[joints[-1]]) if tip is None else _body(model, tip, path, "tip")
    way = upwards(model, last)
    if base is not None:
        first = _body(model, base, path, "base")
        if first not in way:
            raise BadModel(
                f"{path}: body {base!r} does not carry {model.body(last).name!r}: give as base a body that carries it"
            )
        way = way[: way.index(first)]
    chain = [joint for joint in joints if model.jnt_bodyid[joint] in way]
    carriers = upwards(model, int(model.jnt_bodyid[chain[0]])) if chain else []
    joints = [joint for joint in joints if joint in chain or model.jnt_bodyid[joint] not in carriers]
    _refuse_couplings(model, joints if tip is None else chain, path)
    aside = [joint for joint in joints if joint not in chain]
    for joint in chain if aside and tip is not None else joints:
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
            kind = "prismatic" if kind == "slide" else kind
            raise BadModel(f"{path}: joint {model.joint(joint).name} is {kind}: only revolute joints can be identified")
    if aside and tip is None:
        name = model.joint(aside[0]).name
        raise BadModel(
            f"{path}: joint {name} is on a side branch: name the last body of the chain with `tip` (under "
            "kinematics in an arm file, `--tip` on the command line)"
        )
    if not chain:
        raise BadModel(f"{path}: there is no joint between the base and the tip {tip!r}")
    return chain


def _body(model: "mujoco.MjModel", name: str, path: Path, what: str) -> int:
    """Id of a body; raises BadModel."""
    import mujoco

    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    if body < 0:
        names = ", ".join(model.body(body).name for body in range(1, model.nbody))
        raise BadModel(f"{path}: there is no body {name!r} for the {what}; expected one of {names}")
    return body


def _refuse_couplings(model: "mujoco.MjModel", chain: list[int], path: Path) -> None:
    import mujoco

    for equality in range(model.neq):
        coupled = int(model.eq_obj1id[equality])
        if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT and coupled in chain:
            name = model.joint(coupled).name
            raise BadModel(
                f"{path}: joint {name} follows another joint (mimic), but each joint needs its own drive: lock "
                f"joint {name} if it has none"
            )


def _place(
    model: "mujoco.MjModel", chain: list[int], gravity: ArrayLike | None, path: Path, locked: Mapping[int, float]
) -> PlacedChain:
    """Axes, points and inertials in the model's reference configuration, then Denavit-Hartenberg form."""
    import mujoco

    data: Any = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    for joint, position in locked.items():
        data.qpos[model.jnt_qposadr[joint]] = position
    mujoco.mj_kinematics(model, data)
    limited = np.array([bool(model.jnt_limited[joint]) for joint in chain])
    limits = np.where(limited[:, None], model.jnt_range[chain], [-np.inf, np.inf])
    reference = np.array([model.qpos0[model.jnt_qposadr[joint]] for joint in chain])
    link_of = {body: link for body, link in enumerate(links_of_bodies(model, chain)) if link >= 0}
    own = {"its gravity": model.opt.gravity} if gravity is None else {}
    for joint, at_rest in zip(chain, reference, strict=True):
        own[f"joint {model.joint(joint).name}"] = [at_rest, *data.xaxis[joint], *data.xanchor[joint]]
    own |= {f"body {model.body(body).name}": [model.body_mass[body], *data.xipos[body]] for body in link_of}
    _refuse_what_is_no_number(own, path)
    geometry = axes_to_arm(
        names=tuple(model.joint(joint).name or f"joint_{i + 1}" for i, joint in enumerate(chain)),
        axes=data.xaxis[chain],
        points=data.xanchor[chain],
        reference=reference,
        gravity=np.array(model.opt.gravity) if gravity is None else as_array("gravity", gravity, (3,)),
        limits=limits,
    )
    if gravity is not None:
        model.opt.gravity[:] = gravity
    mass, first_moment = np.zeros(len(chain)), np.zeros((len(chain), 3))
    bodies: list[list[int]] = [[] for _ in chain]
    for body, link in link_of.items():
        mass[link] += model.body_mass[body]
        first_moment[link] += model.body_mass[body] * geometry.bar[link].T @ (data.xipos[body] - geometry.origins[link])
        bodies[link].append(body)
    arm = ModelArm(geometry.arm, base_parameters(geometry.arm, mass, first_moment), mass)
    return PlacedChain(
        model, data, arm, geometry, data.xanchor[chain], reference, tuple(map(tuple, bodies)), tuple(chain)
    )


def _refuse_what_is_no_number(values: Mapping[str, ArrayLike], path: Path) -> None:
    """MuJoCo takes NaN and infinity from a file, and all that follows from them is NaN."""
    for of, numbers in values.items():
        if not np.isfinite(numbers).all():
            raise BadModel(f"{path}: {of}: NaN or infinity where a finite number is expected")


def body_in_bar_frame(placed: PlacedChain, link: int, body: int) -> tuple[Array, Array]:
    """(Rotation, origin) of a body's frame in its link's bar frame."""
    bar, data = placed.geometry.bar[link], placed.data
    return bar.T @ data.xmat[body].reshape(3, 3), bar.T @ (data.xpos[body] - placed.geometry.origins[link])


def bar_inertials(placed: PlacedChain) -> Array:
    """Ten inertial parameters of each link about its bar frame's origin, in the bar frame (n, 10)."""
    found = np.zeros((placed.arm.arm.n, 10))
    for link, bodies in enumerate(placed.bodies):
        for body in bodies:
            turn, at = body_in_bar_frame(placed, link, body)
            found[link] += body_parameters(placed.model, body, -turn.T @ at, turn)
    return found


def joint_inertias(placed: PlacedChain, poses: Array, mass: float = 0.0) -> Array:
    """Inertia about each joint's axis [kg·m²] (K, n) of all beyond it, the other joints held, at `poses` (K, n) [rad].

    Rotors are as the model has them; `mass` [kg] is a point on the origin of the last joint.
    """
    import mujoco

    model, data = placed.model, placed.data
    chain = list(placed.joints)
    places, rates = model.jnt_qposadr[chain], model.jnt_dofadr[chain]
    column, found = np.zeros(model.nv), np.empty(poses.shape)
    before = data.qpos.copy()
    for row, pose in enumerate(poses):
        data.qpos[places] = pose
        mujoco.mj_fwdPosition(model, data)
        levers = np.cross(data.xanchor[chain[-1]] - data.xanchor[chain], data.xaxis[chain])
        for joint, rate in enumerate(rates):
            mujoco.mj_mulM(model, data, column, np.eye(model.nv)[rate])
            found[row, joint] = column[rate] + mass * (levers[joint] ** 2).sum()
    data.qpos[:] = before
    mujoco.mj_fwdPosition(model, data)
    return found


def inertial_torque(placed: PlacedChain, q: Array, velocity: Array, acceleration: Array) -> Array:
    """Torque of the model's links beyond gravity (K, n) [N·m] in a motion; (K, n) [rad], [rad/s], [rad/s²]."""
    import mujoco

    model, data = placed.model, mujoco.MjData(placed.model)
    data.qpos[:] = placed.data.qpos
    chain = list(placed.joints)
    places, rates = model.jnt_qposadr[chain], model.jnt_dofadr[chain]
    found, both = np.empty(q.shape), np.zeros((2, model.nv))
    for row in range(len(q)):
        data.qpos[places] = q[row]
        for part, share in zip(both, (1.0, 0.0), strict=True):
            data.qvel[rates], data.qacc[rates] = share * velocity[row], share * acceleration[row]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 1, part)
        found[row] = (both[0] - both[1])[rates]
    return found
