"""URDF and MJCF files as MuJoCo takes them: packages resolved, meshes that cannot be read left out."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Any

from armlink.content.atomic_file import write_whole
from armlink.content.file_content import MOST_TEXT
from armlink.content.memory_budget import memory_budget
from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
log = logging.getLogger(__name__)
READABLE_MESHES = (".stl", ".obj", ".msh")
STL_HEADER, STL_FACE = 84, 50
"""Bytes of a binary STL file: header with the number of faces, and each face. MuJoCo reads no others."""
STL_FACES = range(1, 200_001)
"""Numbers of faces that MuJoCo reads."""
PACKAGE = "package://"
POINTER = b"version https://git-lfs"
"""Beginning of what Git leaves in place of a large file that was not fetched."""
NOT_FOUND, UNFETCHED = "not found", "not fetched (git lfs pull)"
UNREAD, FLAT = "in a form that MuJoCo does not read (it reads binary STL, OBJ and MSH)", "without volume"
"""Why a mesh is of no use."""
FLATNESS = 1e-7
"""Thickness of a mesh over its size below which MuJoCo finds no volume, as STL's single precision has it."""
FINITE = {
    "body_": ("mass", "inertia", "pos", "quat", "ipos", "iquat"),
    "geom_": ("pos", "quat", "size"),
    "jnt_": ("pos", "axis", "stiffness", "range"),
    "dof_": ("armature", "damping", "frictionloss"),
}
"""Fields of a compiled model that must be finite; a range may be infinite."""
KEYS = {"ipos": "centre of mass", "iquat": "axes of the inertia", "quat": "rotation", "pos": "position"}
"""Their names for people, where they differ."""
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


@dataclass(frozen=True)
class ModelFile:
    spec: Any
    """`mujoco.MjSpec`, without the shapes whose meshes are absent."""
    unused_meshes: tuple[tuple[str, str], ...]
    """Mesh files that the model names and that are left out, each with its reason."""
    unphysical: tuple[str, ...]
    """Bodies of a URDF whose inertia has a negative principal moment; it is taken as negligible."""
    kind: str
    """URDF or MJCF."""

    @property
    def left_out(self) -> str:
        """The meshes that are left out, with the reason; nothing if none is."""
        by_reason: dict[str, list[str]] = {}
        for file, reason in self.unused_meshes:
            by_reason.setdefault(reason, []).append(file)
        return " and ".join(
            f"{len(files)} {'mesh' if len(files) == 1 else 'meshes'} {reason}, such as {files[0]}"
            for reason, files in by_reason.items()
        )

    def unphysical_beyond(self, joint: str) -> tuple[str, ...]:
        """The `unphysical` bodies that this joint moves: the inertia of what rests has no effect."""
        first = next((each.parent for each in self.spec.joints if each.name == joint), None)
        moved = set() if first is None else {first.name, *(each.name for each in first.find_all("body"))}
        return tuple(name for name in self.unphysical if name in moved)

    @property
    def shapes(self) -> int:
        """Shapes that can collide, out of those that are there."""
        return sum(bool(geom.contype or geom.conaffinity) for geom in self.spec.geoms)


def read_model(path: Path, locked: Mapping[str, float] | None = None) -> ModelFile:
    """Parse a URDF or MJCF file; raises BadInput if it cannot be read.

    Joints in `locked` have that position [rad, m] in the model's own pose, where joints rest that no arm moves.

    A mesh `package://NAME/…` is looked for in the folders above the file, as ROS lays packages out. A mesh that is not
    there or cannot be read costs its shape only: inertials are in the file itself. MuJoCo's warnings go to the log,
    instead of a file in the working directory.
    """
    import mujoco

    if path.suffix.lower() not in MODEL_SUFFIXES:
        how = f": expand it first: xacro {path} > {path.stem}" if path.suffix.lower() == ".xacro" else ""
        raise BadInput(f"{path}: expected a URDF or MJCF model ({', '.join(MODEL_SUFFIXES)}){how}")
    warned: list[str] = []
    mujoco.set_mju_user_warning(warned.append)
    try:
        with model_budget(path):
            if path.suffix.lower() == ".mjcf":  # a suffix that MuJoCo does not know
                spec = mujoco.MjSpec.from_string(path.read_text(encoding="utf-8"))
                spec.modelfiledir = str(path.resolve().parent)
            else:
                spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, RuntimeError) as error:  # the latter where it gets no memory
        raise BadInput(f"{path}: MuJoCo cannot read this model: {one_line(error)}") from None
    finally:
        mujoco.set_mju_user_warning(log.info)
    if any("NaN" in line for line in warned):  # it takes some of them for values that are not given
        raise BadInput(f"{path}: a number is NaN: expected finite numbers")
    for line in warned:
        log.info(line)
    kind = "URDF" if is_urdf(path) else "MJCF"
    if kind == "URDF":
        compiler = spec.compiler
        compiler.boundmass = compiler.boundinertia = NEGLIGIBLE
        compiler.balanceinertia, compiler.fusestatic = True, False
    folder = path.resolve().parent
    unused: list[tuple[str, str]] = []
    for mesh in list(spec.meshes):
        if not mesh.file:
            continue
        file = _find(mesh.file, folder, folder / spec.compiler.meshdir)
        bodies = [geom.parent for geom in spec.geoms if geom.meshname == mesh.name]
        weighed = [body.name for body in bodies if not body.explicitinertial and body.name != "world"]
        reason = NOT_FOUND if file is None else "" if mesh.content_type else _why_useless(file)
        if not reason:
            mesh.file = str(file)
            if kind == "URDF" and not weighed:
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # some enclose hardly any volume
            continue
        unused.append((mesh.file, reason))
        if weighed and kind == "MJCF":
            raise BadInput(
                f"{path}: mesh {mesh.file} is {reason}, and body {weighed[0]!r} has its mass from this mesh "
                "alone: put a mesh that MuJoCo can read next to the model, or give the body an `inertial`"
            )
        _drop(spec, mesh)
    for texture in list(spec.textures):
        if texture.file and _find(texture.file, folder, folder / spec.compiler.texturedir) is None:
            _drop_texture(spec, texture)
    if kind == "URDF":
        spec.strippath = False  # the meshes' paths are absolute by now
    unphysical = _negative_inertias_removed(spec) if kind == "URDF" else ()
    for name, position in (locked or {}).items():
        _rest_at(spec, name, position, path)
    return ModelFile(spec, tuple(unused), unphysical, kind)


def expand_xacro(path: Path, out: Path) -> Path:
    """The URDF of a xacro file, written to `out`; raises BadInput where xacro is missing or cannot expand it."""
    try:
        import xacro
    except ModuleNotFoundError:
        raise BadInput(
            f"{path} is a xacro file: install xacro (pip install xacro), or expand the file yourself: xacro "
            f"{path} > {out}"
        ) from None
    try:
        text = xacro.process_file(str(path)).toxml()
    except Exception as error:  # of many kinds: of XML, of expressions, of packages that are not found
        what = f"{path}: xacro cannot expand it: {one_line(error)}"
        raise BadInput(
            f"{what}: $(find PACKAGE) and arguments need ROS: on a machine with ROS, run xacro {path} > {out}"
        ) from None
    write_whole(out, text)
    return out


def _rest_at(spec: Any, name: str, position: float, path: Path) -> None:
    """Give a joint another position [rad, m] in the model's own pose: its body moves, and the joint's reference."""
    import mujoco
    import numpy as np

    joint = spec.joint(name)
    if joint is None:
        joints = ", ".join(each.name for each in spec.joints)
        raise BadInput(f"{path}: there is no joint {name!r} to lock; the joints are {joints}")
    hinge, body = joint.type == mujoco.mjtJoint.mjJNT_HINGE, joint.parent
    if not hinge and joint.type != mujoco.mjtJoint.mjJNT_SLIDE:
        raise BadInput(f"{path}: joint {name!r} cannot be locked: it is neither revolute nor prismatic")
    if body.joints[0].name != name:
        raise BadInput(
            f"{path}: joint {name!r} cannot be locked, since joint {body.joints[0].name!r} moves the same body"
        )
    unit = np.pi / 180 if hinge and joint.compiler.degree else 1.0
    if joint.range[0] < joint.range[1] and not joint.range[0] <= position / unit <= joint.range[1]:
        low, high = unit * joint.range
        raise BadInput(f"{path}: joint {name!r} cannot be locked at {position:g}: its range is {low:g} to {high:g}")
    way, axis = position - unit * joint.ref, joint.axis / np.linalg.norm(joint.axis)
    if body.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        compiler = body.compiler
        body.quat = spec.resolve_orientation(bool(compiler.degree), compiler.eulerseq, body.alt)
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    shift, turned, turn = np.zeros(3), np.zeros(4), np.array([1.0, 0.0, 0.0, 0.0])
    if hinge:
        mujoco.mju_axisAngle2Quat(turn, axis, way)
        mujoco.mju_rotVecQuat(shift, joint.pos, turn)
    moved = joint.pos - shift if hinge else way * axis
    mujoco.mju_rotVecQuat(shift, moved, body.quat)
    mujoco.mju_mulQuat(turned, body.quat, turn)
    body.pos, body.quat, joint.ref = body.pos + shift, turned, position / unit


def compile_model(path: Path, beside: Sequence[Beside] = (), locked: Mapping[str, float] | None = None) -> Any:
    """The file as a compiled `mujoco.MjModel`, with others beside it; raises BadInput if one cannot be used.

    `locked` is as in `read_model`.
    """
    import mujoco
    import numpy as np

    found, turned = read_model(path, locked), np.empty(4)
    for each in beside:
        mujoco.mju_euler2Quat(turned, np.array(each.turned), "XYZ")
        frame = found.spec.worldbody.add_frame(pos=each.at, quat=turned)
        found.spec.attach(read_model(each.path).spec, prefix=each.prefix, frame=frame)
    return compile_spec(found.spec, path, f" (without {found.left_out})" if found.left_out else "")


def compile_spec(spec: Any, path: Path, hint: str = "") -> Any:
    """A parsed model as `mujoco.MjModel`; raises BadInput with the file's name."""
    import mujoco

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are in the log
            with memory_budget(path):
                model = spec.compile()
                mujoco.MjData(model)  # has an arena of a size that the file may state
    except (ValueError, RuntimeError) as error:  # the latter where it gets no memory
        raise BadInput(f"{path}: MuJoCo cannot compile it{hint}: {one_line(error)}") from None
    _refuse_what_is_no_number(model, path)
    return model


def add_actuator(spec: Any, name: str, target: str, kind: Any = None) -> Any:
    """Add a motor of gear 1 on a joint, or on another kind of target, to an `MjSpec`: without its file's defaults."""
    import mujoco

    made = spec.add_actuator(name=name, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT if kind is None else kind)
    made.set_to_motor()
    made.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    made.ctrllimited = made.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    made.armature, made.damping = 0.0, 0.0 * made.damping
    return made


def _refuse_what_is_no_number(model: Any, path: Path) -> None:
    """MuJoCo takes NaN and infinity from a file, and all that follows from them is NaN."""
    import numpy as np

    of_joint = [f"joint {model.joint(joint).name!r}" for joint in range(model.njnt)]
    owners = {
        "body_": [f"body {model.body(body).name!r}" for body in range(model.nbody)],
        "geom_": [f"a shape of body {model.body(body).name!r}" for body in model.geom_bodyid],
        "jnt_": of_joint,
        "dof_": [of_joint[joint] for joint in model.dof_jntid],
    }
    for place, names in owners.items():
        for key in FINITE[place] if names else ():
            rows = np.reshape(getattr(model, place + key), (len(names), -1))
            right = (~np.isnan(rows) if key == "range" else np.isfinite(rows)).all(axis=1)
            if not right.all():
                what = f"{names[int(np.argmin(right))]}: {KEYS.get(key, key)}"
                raise BadInput(f"{path}: {what}: NaN or infinity where a finite number is expected")


def one_line(error: Exception) -> str:
    """MuJoCo's message, which spans several lines, in one."""
    return " ".join(str(error).split())


def is_urdf(path: Path) -> bool:
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


def _why_useless(mesh: Path) -> str:
    """Why MuJoCo makes no shape of a mesh file, empty where it does.

    STL has a text form under the same suffix; a file may be another one's pointer, or have no volume.
    """
    suffix = mesh.suffix.lower()
    try:
        with mesh.open("rb") as file:
            head = file.read(STL_HEADER)
        if head.startswith(POINTER):
            return UNFETCHED
        size = mesh.stat().st_size
        if suffix == ".stl":
            faces = int.from_bytes(head[STL_HEADER - 4 :], "little")
            if faces not in STL_FACES or size != STL_HEADER + STL_FACE * faces:
                return UNREAD
        elif suffix not in READABLE_MESHES or size > MOST_TEXT:
            return UNREAD
        return FLAT if suffix != ".msh" and _is_flat(_vertices(mesh)) else ""
    except OSError:
        return UNREAD


def _vertices(mesh: Path) -> Any:
    """Vertices (K, 3) of a binary STL or an OBJ file; of one that cannot be parsed none."""
    import numpy as np

    if mesh.suffix.lower() == ".stl":
        face = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        return np.fromfile(mesh, face, offset=STL_HEADER)["corners"].reshape(-1, 3).astype(float)
    rows = [line.split()[1:4] for line in mesh.read_bytes().splitlines() if line.startswith(b"v ")]
    try:
        return np.array(rows, dtype=float).reshape(-1, 3)
    except ValueError:
        return np.empty((0, 3))


def _is_flat(vertices: Any) -> bool:
    import numpy as np

    if len(vertices) < 4:
        return True
    spread = vertices - vertices.mean(axis=0)
    sizes = np.linalg.eigvalsh(spread.T @ spread)
    return not sizes[0] > FLATNESS**2 * sizes[-1]


def _negative_inertias_removed(spec: Any) -> tuple[str, ...]:
    """Make negative principal moments negligible, which MuJoCo refuses; names of the bodies that had one."""
    import numpy as np

    changed = []
    for body in spec.bodies:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        if not np.isfinite(body.fullinertia).all():
            continue
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if moments[0] < 0.0:
            kept = axes @ np.diag(np.maximum(moments, 2.0 * NEGLIGIBLE)) @ axes.T
            body.fullinertia = [*np.diag(kept), kept[0, 1], kept[0, 2], kept[1, 2]]
            changed.append(body.name)
    return tuple(changed)


def _drop(spec: Any, mesh: Any) -> None:
    for geom in list(spec.geoms):
        if geom.meshname == mesh.name:
            spec.delete(geom)
    spec.delete(mesh)


def _drop_texture(spec: Any, texture: Any) -> None:
    for material in spec.materials:
        material.textures = ["" if each == texture.name else each for each in material.textures]
    spec.delete(texture)
