"""A model with what was found of an arm as a file: URDF or MJCF, and base parameters as parameters of a ROS 2 node."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from armlink.content.atomic_file import write_whole, writing
from armlink.content.printable_text import printable_text
from armlink.content.yaml_text import yaml_document
from armlink.errors import BadInput
from gcomp.arm.arm import Arm
from gcomp.arm.consistent_bodies import with_moments
from gcomp.arm.inertials import body_parameters, mass_centre_inertia, write_bodies
from gcomp.arm.load import PlacedChain, compiled_spec
from gcomp.arm.mass_moments import base_parameter_names
from gcomp.arm.model_file import linear_part, parse_xml
from gcomp.arrays import Array

GHOST = 1e-12
"""Mass below which a body is one that a URDF file gives none [kg]."""


def write_model(placed: PlacedChain, source: Path, beta: Array, path: Path) -> None:
    """Write the model of the file `source` with mass moments β (2n,) [kg·m], as URDF if `path` ends so, else as MJCF.

    Raises BadInput where it cannot be written.
    """
    spec, nominal = compiled_spec(source)
    write_bodies(spec, nominal, with_moments(placed, beta))
    compiled = spec.compile()
    if path.suffix.lower() == URDF:
        compiled.body_mass[compiled.body_mass < GHOST] = 0.0
        text = urdf_of(compiled, source if source.suffix.lower() == URDF else None)[0]
    else:
        text = spec.to_xml()
    with writing(path):
        write_whole(path, text)


def write_coefficients(arm: Arm, beta: Array, std: Array, path: Path) -> None:
    """Write base parameters as YAML; raises BadInput where it cannot be written.

    Torque is τ = Y(q) β, Y the regressor of docs/identification.md for these Denavit-Hartenberg rows.
    """
    every = [f"mass_moment_{axis}[{name}]" for name in arm.names for axis in "xy"]
    acting = [every.index(name) for name in base_parameter_names(arm)]
    rows = {key: getattr(arm, key).tolist() for key in ("alpha", "a", "d", "theta_offset")}
    parameters = {
        "joints": list(arm.names),
        "gravity": arm.gravity.tolist(),
        "denavit_hartenberg": {**rows, "b": np.asarray(arm.b).tolist()},
        "base_parameters": {
            "names": [every[k] for k in acting],
            "values": beta[acting].tolist(),
            "standard_deviations": std[acting].tolist(),
        },
    }
    with writing(path):
        write_whole(path, yaml_document({"/**": {"ros__parameters": {"gravity_model": parameters}}}))


def xml_comment(lines: list[str]) -> str:
    """Lines as an XML comment; two hyphens, which would end it, are parted."""
    text = "\n  ".join(map(printable_text, lines))
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!-- {text}\n-->\n"


URDF = ".urdf"
KINDS = {2: "prismatic", 3: "revolute"}
"""MuJoCo's numbers of types of joints → URDF's, with limits."""
NO_LIMIT = {"effort": "1e4", "velocity": "1e3"}
"""Limits that URDF asks of every joint, where a model has none."""
EARTH = np.array([0.0, 0.0, -9.81])


def urdf_of(model: Any, source: Path | None, effects: Sequence[str] = ()) -> tuple[str, list[str]]:
    """The text of a compiled `mujoco.MjModel` as URDF, and a line for all that URDF has no field for, `effects` first.

    A model that was read from the URDF file `source` keeps all else that is in it, its shapes too; of any other the
    links and joints are written, without shapes. Raises BadInput for joints that are neither hinges nor slides.
    """
    root = _changed(model, source) if source is not None else _made(model)
    lines = [*effects, *_left_out(model), *(_moved_zeros(model) if source is not None else ())]
    ET.indent(root)
    text = xml_comment(["These values have no place in URDF, so set them in the simulator:", *lines]) if lines else ""
    return '<?xml version="1.0"?>\n' + text + ET.tostring(root, encoding="unicode") + "\n", lines


def _left_out(model: Any) -> list[str]:
    """Parts of the model beside links and joints, a line each."""
    lines = []
    fields = (
        ("armature", model.dof_armature, "kg·m²"),
        ("stiffness", linear_part(model.jnt_stiffness, model.njnt), "N·m/rad"),
    )
    for key, values, unit in fields:
        at = model.jnt_dofadr if key == "armature" else range(model.njnt)
        for joint, place in enumerate(at):
            if values[place] > 0.0:
                lines.append(f"{key} of {model.joint(joint).name}: {values[place]:.6g} {unit}")
    if not np.allclose(model.opt.gravity, EARTH, atol=0.02):
        lines.append(f"gravity: {_numbers(model.opt.gravity)} m/s²")
    if model.ntendon:
        lines.append(f"{model.ntendon} tendons")
    return lines


def _moved_zeros(model: Any) -> list[str]:
    """Joints that the arm reads otherwise than the file counts them, a line each."""
    zeros = [(model.joint(joint).name, float(model.qpos0[model.jnt_qposadr[joint]])) for joint in range(model.njnt)]
    return [
        f"zero of {name}: the arm reads {zero:.6g} rad more than a simulation of this file"
        for name, zero in zeros
        if zero != 0.0
    ]


def _changed(model: Any, source: Path) -> ET.Element:
    """The URDF file with the model's inertials and joints."""
    root = parse_xml(source.read_bytes())
    bodies = {model.body(body).name: body for body in range(1, model.nbody)}
    joints = {model.joint(joint).name: joint for joint in range(model.njnt)}
    for link in root.iter("link"):
        if (body := bodies.get(link.get("name", ""))) is not None and model.body_mass[body] > 0.0:
            _put_inertial(link, *mass_centre_inertia(body_parameters(model, body, np.zeros(3), np.eye(3))))
    for joint in root.iter("joint"):
        if (number := joints.get(joint.get("name", ""))) is not None:
            _put_dynamics(joint, model, number)
    return root


def _made(model: Any) -> ET.Element:
    """Links and joints of any model: the frame of a link lies on its joint, turned as the body is with all at zero."""
    import mujoco

    if {int(kind) for kind in model.jnt_type} - set(KINDS):
        raise BadInput("--out-model: URDF can hold only hinges and slides: write MJCF (.xml)")
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    root, name = ET.Element("robot", name="corrected"), {0: "world"}
    ET.SubElement(root, "link", name="world")
    at: dict[int, tuple[Array, Array]] = {0: (np.eye(3), np.zeros(3))}
    for body in range(1, model.nbody):
        own = [joint for joint in range(model.njnt) if model.jnt_bodyid[joint] == body]
        up, turn = int(model.body_parentid[body]), data.xmat[body].reshape(3, 3)
        name[body], frame, above = model.body(body).name or f"body_{body}", at[up], name[up]
        for joint in own[:-1]:  # a body with several joints: massless links between them
            between = f"{name[body]}_{model.joint(joint).name or joint}"
            here = (turn, data.xanchor[joint])
            ET.SubElement(root, "link", name=between)
            _add_joint(root, model, joint, (above, between), frame, here, turn.T @ data.xaxis[joint])
            frame, above = here, between
        link = ET.SubElement(root, "link", name=name[body])
        at[body] = (turn, data.xanchor[own[-1]] if own else data.xpos[body])
        spin = turn.T @ data.ximat[body].reshape(3, 3)
        centre = turn.T @ (data.xipos[body] - at[body][1])
        if model.body_mass[body] > 0.0:
            inertia = spin @ np.diag(model.body_inertia[body]) @ spin.T
            _put_inertial(link, float(model.body_mass[body]), centre, inertia)
        axis = turn.T @ data.xaxis[own[-1]] if own else None
        _add_joint(root, model, own[-1] if own else None, (above, name[body]), frame, at[body], axis)
    return root


def _add_joint(
    root: ET.Element,
    model: Any,
    number: int | None,
    ends: tuple[str, str],
    above: tuple[Array, Array],
    here: tuple[Array, Array],
    axis: Array | None,
) -> None:
    """A joint between two links whose frames (rotation, origin) are given in the world; fixed if it has no number."""
    limited = number is not None and bool(model.jnt_limited[number])
    kind = "fixed" if number is None else KINDS[int(model.jnt_type[number])]
    kind = "continuous" if kind == "revolute" and not limited else kind
    label = f"{ends[1]}_fixed" if number is None else model.joint(number).name or f"joint_{number + 1}"
    joint = ET.SubElement(root, "joint", name=label, type=kind)
    ET.SubElement(joint, "parent", link=ends[0])
    ET.SubElement(joint, "child", link=ends[1])
    turn = above[0].T @ here[0]
    ET.SubElement(joint, "origin", xyz=_numbers(above[0].T @ (here[1] - above[1])), rpy=_numbers(_angles(turn)))
    if number is None or axis is None:
        return
    ET.SubElement(joint, "axis", xyz=_numbers(axis))
    bounds: dict[str, str] = {}
    if limited:
        bounds = dict(zip(("lower", "upper"), map(_number, model.jnt_range[number]), strict=True))
    effort = model.jnt_actfrcrange[number][1] if model.jnt_actfrclimited[number] else None
    given = NO_LIMIT | ({} if effort is None else {"effort": _number(effort)})
    ET.SubElement(joint, "limit", {**bounds, **given})
    _put_dynamics(joint, model, number)


def _put_inertial(link: ET.Element, mass: float, centre: Array, inertia: Array) -> None:
    """Give a link mass, centre of mass and inertia about it [kg·m²], in its own frame."""
    for old in link.findall("inertial"):
        link.remove(old)
    inertial = ET.Element("inertial")
    link.insert(0, inertial)
    ET.SubElement(inertial, "origin", xyz=_numbers(centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_number(mass))
    places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: _number(inertia[place]) for key, place in places.items()})


def _put_dynamics(joint: ET.Element, model: Any, number: int) -> None:
    """Give a joint the model's damping and friction."""
    for old in joint.findall("dynamics"):
        joint.remove(old)
    dof = int(model.jnt_dofadr[number])
    damping, friction = float(linear_part(model.dof_damping, model.nv)[dof]), float(model.dof_frictionloss[dof])
    ET.SubElement(joint, "dynamics", damping=_number(damping), friction=_number(friction))


def _angles(turn: Array) -> Array:
    """Roll, pitch and yaw of a rotation, (3,) [rad]."""
    pitch = np.arctan2(-turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    if np.hypot(turn[0, 0], turn[1, 0]) < 1e-9:  # yaw and roll turn about one axis
        return np.array([np.arctan2(-turn[1, 2], turn[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0])])


def _number(value: float) -> str:
    return f"{float(value):.10g}"


def _numbers(values: Array) -> str:
    return " ".join(_number(float(value)) for value in values)
