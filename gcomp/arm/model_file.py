"""XML of model files, read as leniently as ROS and MuJoCo do, and the tree of bodies and joints of a compiled one."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING
from xml.parsers import expat

import numpy as np

from gcomp.arrays import Array

if TYPE_CHECKING:
    import mujoco

HAND = re.compile(r"grip|hand|jaw|claw|finger|thumb|(?<![a-z])(index|middle|ring|pinky|little)(?![a-z])", re.IGNORECASE)
"""Names of joints that grasp rather than move the arm."""


class NotXml(ValueError):
    """Not well-formed XML."""


def parse_xml(source: bytes) -> ET.Element:
    """The root element of a model file; raises NotXml, in one line.

    Names with a colon stay as they are: published URDF files have tags such as `drake:acceleration` whose prefix they
    do not declare. Readers without namespaces, as those of ROS and MuJoCo, take them; xml.etree by itself refuses.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        raise NotXml(str(error)) from None
    return builder.close()


def upwards(model: "mujoco.MjModel", body: int) -> list[int]:
    """The body and those that carry it, up to the world."""
    found = [body]
    while found[-1]:
        found.append(int(model.body_parentid[found[-1]]))
    return found


def links_of_bodies(model: "mujoco.MjModel", joints: Sequence[int]) -> list[int]:
    """The link, of those that the joints move, that each body belongs to; −1 for one that none carries."""
    moved = {int(model.jnt_bodyid[joint]): link for link, joint in enumerate(joints)}
    return [next((moved[up] for up in upwards(model, body) if up in moved), -1) for body in range(model.nbody)]


def carried_bodies(model: "mujoco.MjModel", bodies: Iterable[int]) -> list[int]:
    """These bodies and those that they carry."""
    found = {int(body) for body in bodies}
    for body in range(1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return sorted(found)


def coupled_joints(model: "mujoco.MjModel") -> dict[str, str]:
    """Joint → joint that an equality couples it with (mimic joints), both ways."""
    import mujoco

    pairs: dict[str, str] = {}
    for equality in range(model.neq):
        if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[equality] >= 0:
            first, second = (model.joint(int(each[equality])).name for each in (model.eq_obj1id, model.eq_obj2id))
            pairs |= {first: second, second: first}
    return pairs


def linear_part(values: Array, count: int) -> Array:
    """View of the linear coefficients (count,) of a MuJoCo field that may hold polynomials, such as `dof_damping`."""
    return np.reshape(values, (count, -1))[:, 0]
