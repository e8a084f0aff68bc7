"""Identified mass moments back into URDF or MJCF: the nearest feasible inertials with the same gravity torque."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gcomp.arm.feasible_inertials import Bounds, Inertials, nearest_inertials
from gcomp.arm.load import PlacedChain, place_chain
from gcomp.arm.model_xml import parse_xml
from gcomp.arrays import Array, as_array
from gcomp.errors import BadModel

LEAST_SHARE = 0.1
"""Smallest share of its mass that a body keeps, so that no mass comes near zero; a choice."""


@dataclass(frozen=True, eq=False)
class LinkChange:
    """Change of one link by writing back; centres of mass in the body's own frame."""

    joint: str
    body: str
    mass_before: float
    mass_after: float
    com_before: Array
    com_after: Array

    @property
    def moved(self) -> float:
        """How far the centre of mass moved [m]."""
        return float(np.linalg.norm(self.com_after - self.com_before))


def write_model(
    source: Path,
    target: Path,
    beta: Array,
    *,
    base: str | None = None,
    tip: str | None = None,
    bounds: Bounds | None = None,
) -> tuple[LinkChange, ...]:
    """Write `source` to `target` with inertials that have mass moments β (2n,) [kg·m]; returns the change of each link.

    The heaviest body of each link changes, its inertia about the centre of mass in proportion to its mass. NaN in β
    marks an unknown moment. Raises NotFeasible if no inertials within the bounds have β (by default every body keeps
    a tenth of its mass), BadModel if the file cannot hold them.
    """
    placed = place_chain(source, base=base, tip=tip)
    wanted = as_array("beta", beta, (2 * placed.arm.arm.n,), finite=False)
    for name, bodies in zip(placed.arm.arm.names, placed.bodies, strict=True):
        if not bodies or not placed.model.body_mass[list(bodies)].any():
            raise BadModel(f"{source}: joint {name} moves no mass of its own: no body can hold its mass moments")
    carriers = [max(bodies, key=lambda body: placed.model.body_mass[body]) for bodies in placed.bodies]
    nominal = Inertials(placed.arm.mass, placed.arm.first_moment)
    heaviest = placed.model.body_mass[carriers]
    limits = bounds or Bounds.positive(nominal.mass - (1 - LEAST_SHARE) * heaviest)
    found = nearest_inertials(wanted, nominal, limits, placed.geometry.base_parameters)
    root = parse_xml(source.read_bytes())
    changes = []
    for link, body in enumerate(carriers):
        change = _change(placed, link, body, found)
        if change.mass_after <= 0:
            raise BadModel(
                f"{source}: body {change.body} would get a mass of {change.mass_after:.3g} kg: raise its lower bound"
            )
        element = _element(root, placed, body, source)
        (_write_urdf if root.tag == "robot" else _write_mjcf)(element, placed, body, change)
        changes.append(change)
    target.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))
    _check(target, base, tip, wanted, source)
    return tuple(changes)


def _change(placed: PlacedChain, link: int, body: int, found: Inertials) -> LinkChange:
    """The body's new mass and centre of mass: it takes the whole change of its link."""
    model, data = placed.model, placed.data
    rotation = np.asarray(data.xmat[body]).reshape(3, 3)
    before, more = float(model.body_mass[body]), float(found.mass[link] - placed.arm.mass[link])
    gained = placed.geometry.bar[link] @ (found.first_moment[link] - placed.arm.first_moment[link])
    about_anchor = before * (data.xipos[body] - placed.anchors[link]) + gained
    about_origin = about_anchor - (before + more) * (data.xpos[body] - placed.anchors[link])
    return LinkChange(
        joint=placed.arm.arm.names[link],
        body=model.body(body).name,
        mass_before=before,
        mass_after=before + more,
        com_before=np.array(model.body_ipos[body]),
        com_after=rotation.T @ about_origin / (before + more),
    )


def _element(root: ET.Element, placed: PlacedChain, body: int, source: Path) -> ET.Element:
    """The body's element: a URDF link by name, an MJCF body by its place in the file."""
    name = placed.model.body(body).name
    if root.tag == "robot":
        return next(link for link in root.iter("link") if link.get("name") == name)
    compiler = root.find("compiler")
    if compiler is not None and compiler.get("inertiafromgeom") == "true":
        raise BadModel(f"{source}: inertiafromgeom is true: MuJoCo would ignore the inertials; set it to auto")
    bodies = [element for world in root.iter("worldbody") for element in world.iter("body")]
    if len(bodies) != placed.model.nbody - 1:
        raise BadModel(f"{source}: it includes or replicates bodies: save it as a single file first")
    return bodies[body - 1]


def _write_mjcf(element: ET.Element, placed: PlacedChain, body: int, change: LinkChange) -> None:
    inertial = element.find("inertial")
    if inertial is None:
        inertial = ET.Element("inertial")
        element.insert(0, inertial)
    inertial.attrib.clear()
    inertia = placed.model.body_inertia[body] * change.mass_after / change.mass_before
    values = {"pos": change.com_after, "quat": placed.model.body_iquat[body], "diaginertia": inertia}
    inertial.set("mass", repr(change.mass_after))
    for key, value in values.items():
        inertial.set(key, _numbers(value))


def _write_urdf(element: ET.Element, placed: PlacedChain, body: int, change: LinkChange) -> None:
    inertial = element.find("inertial")
    if inertial is None:
        raise BadModel(f"link {change.body} has no inertial to change")
    origin = inertial.find("origin")
    if origin is None:
        origin = ET.SubElement(inertial, "origin")
    origin.set("xyz", _numbers(change.com_after))
    for mass in inertial.iter("mass"):
        mass.set("value", repr(change.mass_after))
    for inertia in inertial.iter("inertia"):
        for key, value in inertia.attrib.items():
            inertia.set(key, repr(float(value) * change.mass_after / change.mass_before))


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def _check(target: Path, base: str | None, tip: str | None, wanted: Array, source: Path) -> None:
    """Read the written file back: some compiler options change inertials after reading."""
    found = place_chain(target, base=base, tip=tip).arm.beta
    if np.nanmax(np.abs(found - wanted), initial=0.0) > 1e-9:
        target.unlink()
        raise BadModel(
            f"{source}: its compiler options change inertials (settotalmass, boundmass, …): remove them first"
        )
