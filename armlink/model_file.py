"""URDF and MJCF files as MuJoCo takes them: packages resolved, meshes that are not there left out."""

from collections.abc import Sequence
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Any

from armlink.errors import BadInput

READABLE_MESHES = (".stl", ".obj", ".msh")
PACKAGE = "package://"
NEGLIGIBLE = 1e-14
"""Mass [kg] and inertia [kg·m²] of massless moving bodies, which are common in URDF files and MuJoCo refuses."""


@dataclass(frozen=True)
class Beside:
    """A model that stands beside another one."""

    path: Path
    at: tuple[float, float, float]
    """Its origin in the other's world frame [m]."""
    turned: tuple[float, float, float]
    """Rotation about that frame's x, then y, then z axis [rad]."""
    prefix: str
    """What the names of its bodies and joints begin with."""


@dataclass(frozen=True)
class ModelFile:
    """A model file, parsed."""

    spec: Any
    """`mujoco.MjSpec`, without the shapes whose meshes are absent."""
    absent: tuple[str, ...]
    """Mesh files that the model names and that are not there, or in a format that MuJoCo does not read."""
    kind: str
    """URDF or MJCF."""

    @property
    def shapes(self) -> int:
        """Shapes that can collide, out of those that are there."""
        return sum(bool(geom.contype or geom.conaffinity) for geom in self.spec.geoms)


def read_model(path: Path) -> ModelFile:
    """Parse a URDF or MJCF file; raises BadInput if it cannot be read.

    A mesh `package://NAME/…` is looked for in the folders above the file, as ROS lays packages out. A mesh that is not
    there costs its shape only: inertials are in the file itself.
    """
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise BadInput(f"{path}: not a model that MuJoCo reads: {one_line(error)}") from None
    kind = "URDF" if _is_urdf(path) else "MJCF"
    if kind == "URDF":
        compiler = spec.compiler
        compiler.boundmass = compiler.boundinertia = NEGLIGIBLE
        compiler.balanceinertia, compiler.fusestatic = True, False
    folder = path.resolve().parent
    absent = []
    for mesh in list(spec.meshes):
        if not mesh.file:
            continue
        file = _find(mesh.file, folder, folder / spec.compiler.meshdir)
        if file is not None and (file.suffix.lower() in READABLE_MESHES or mesh.content_type):
            mesh.file = str(file)
            continue
        absent.append(mesh.file)
        weighed = [geom.parent.name for geom in spec.geoms if geom.meshname == mesh.name and not _has_inertial(geom)]
        if weighed and kind == "MJCF":
            raise BadInput(
                f"{path}: mesh {mesh.file} is not there, and body {weighed[0]!r} has its mass from it alone: put the "
                "mesh beside the model, or give the body an inertial"
            )
        _drop(spec, mesh)
    for texture in list(spec.textures):
        if texture.file and _find(texture.file, folder, folder / spec.compiler.texturedir) is None:
            _drop_texture(spec, texture)
    if kind == "URDF":
        spec.strippath = False  # the meshes' paths are absolute by now
    return ModelFile(spec, tuple(absent), kind)


def compile_model(path: Path, beside: Sequence[Beside] = ()) -> Any:
    """The file as a compiled `mujoco.MjModel`, with others beside it; raises BadInput if one cannot be used."""
    found = read_model(path)
    for each in beside:
        frame = found.spec.worldbody.add_frame(pos=each.at, quat=_quaternion(each.turned))
        found.spec.attach(read_model(each.path).spec, prefix=each.prefix, frame=frame)
    try:
        return found.spec.compile()
    except ValueError as error:
        hint = f" (without the meshes {', '.join(found.absent)}, which are not there)" if found.absent else ""
        raise BadInput(f"{path}: MuJoCo cannot compile it{hint}: {one_line(error)}") from None


def _quaternion(turned: tuple[float, float, float]) -> Any:
    import mujoco
    import numpy as np

    found = np.empty(4)
    mujoco.mju_euler2Quat(found, np.array(turned), "XYZ")
    return found


def one_line(error: ValueError) -> str:
    """MuJoCo's message, which spans several lines, in one."""
    return " ".join(str(error).split())


def _is_urdf(path: Path) -> bool:
    """Whether the root element is `robot`; without namespaces, whose prefixes published files do not declare."""
    from xml.parsers import expat

    tags: list[str] = []
    reader = expat.ParserCreate()
    reader.StartElementHandler = lambda tag, _: tags.append(tag)
    try:
        reader.Parse(path.read_bytes(), True)
    except (expat.ExpatError, OSError):
        return False
    return tags[:1] == ["robot"]


def _find(name: str, *folders: Path) -> Path | None:
    """The file that a model names, or None: beside it, in its mesh folder, or in a package above."""
    if name.startswith(PACKAGE):
        package, _, rest = name.removeprefix(PACKAGE).partition("/")
        above = [folders[0], *folders[0].parents]
        tries = [folder / package / rest for folder in above]
        tries += [folder / rest for folder in above if folder.name == package]
    else:
        tries = [folder / name.removeprefix("file://") for folder in folders]
    return next((each for each in tries if isfile(each)), None)


def _has_inertial(geom: Any) -> bool:
    """Whether the body of a shape has its mass stated, or does not move."""
    return bool(geom.parent.explicitinertial) or geom.parent.name == "world"


def _drop(spec: Any, mesh: Any) -> None:
    for geom in list(spec.geoms):
        if geom.meshname == mesh.name:
            spec.delete(geom)
    spec.delete(mesh)


def _drop_texture(spec: Any, texture: Any) -> None:
    for material in spec.materials:
        material.textures = ["" if each == texture.name else each for each in material.textures]
    spec.delete(texture)
