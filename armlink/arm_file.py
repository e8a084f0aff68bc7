"""The arm file: one YAML file that says what the arm is, one section per package (docs/formats.md, section 1)."""

import hashlib
import json
import os
import shlex
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from armlink.arrays import Array
from armlink.content.file_content import MOST_TEXT, parse_yaml, read_whole
from armlink.contributed import contributions, load_contribution
from armlink.errors import BadInput
from armlink.key_errors import describe, describe_all, suggest_key
from armlink.model_file import MODEL_SUFFIXES
from armlink.names import JointName, Name

SIMULATED = "armlink_sim"
"""Interface of a simulated arm in this process; its channel is an arm file."""
STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
LONGEST_DEADLINE = 10.0
"""Of a link [s]."""


Positive = Annotated[FiniteFloat, Field(gt=0)]
"""A limit, or another number that is neither infinite nor zero nor less."""


class Section(BaseModel):
    """Base of every part of the arm file: unknown keys are errors, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


S = TypeVar("S", bound=Section)


class BadKeys(BadInput):
    """Keys of an arm file that cannot be used; the message names the first."""

    def __init__(self, path: Path, first: str, keys: list[tuple[str, str]]) -> None:
        """`keys` are (key, what is wrong with it), all of them."""
        super().__init__(f"{path}: {first}")
        self.keys = keys


class DhJoint(Section):
    """One revolute joint in standard Denavit-Hartenberg form; `lower` and `upper` are its mechanical stops."""

    name: JointName
    a: FiniteFloat = 0.0
    """Link length [m]."""
    alpha: FiniteFloat = 0.0
    """Link twist [rad]."""
    d: FiniteFloat = 0.0
    """Link offset [m]."""
    theta_offset: FiniteFloat = 0.0
    """Denavit-Hartenberg angle at joint position zero [rad]."""
    lower: FiniteFloat
    """Lower mechanical stop [rad]."""
    upper: FiniteFloat
    """Upper mechanical stop [rad]."""

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> "DhJoint":
        if self.lower >= self.upper:
            raise ValueError(f"joint {self.name}: lower {self.lower} must be less than upper {self.upper} [rad]")
        return self


Range = Annotated[tuple[FiniteFloat, ...], Field(min_length=2, max_length=2)]


class Kinematics(Section):
    """Where the joints are: Denavit-Hartenberg rows from base to tip, or a URDF or MJCF model."""

    gravity: Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)] = STANDARD_GRAVITY
    """Acceleration of gravity in the base frame [m/s²]."""
    joints: tuple[DhJoint, ...] = ()
    model: Path | None = None
    """URDF or MJCF file instead of `joints`, relative to the arm file."""
    base: str | None = None
    """Body of the model that carries the chain; joints that move it keep the model's position. Default: the world."""
    tip: str | None = None
    """Body of the model that the chain ends in; by default its last."""
    stops: dict[str, Range] = {}
    """Mechanical stops (lower, upper) [rad] of joints of the model by name, instead of the model's own limits."""
    locked: dict[str, FiniteFloat] = {}
    """Joints of the model that are held by other means, at this position [rad, m]: their load is the carrier's."""

    @model_validator(mode="after")
    def _one_description(self) -> "Kinematics":
        if bool(self.joints) == (self.model is not None):
            raise ValueError("give either `joints` (Denavit-Hartenberg rows) or `model` (URDF or MJCF), not both")
        _no_twins([joint.name for joint in self.joints])
        if self.stops and self.joints:
            raise ValueError("`stops` belongs to a model: Denavit-Hartenberg rows have `lower` and `upper`")
        if self.locked and self.joints:
            raise ValueError("`locked` belongs to a model: if a joint is held, leave out its Denavit-Hartenberg row")
        for name, (lower, upper) in self.stops.items():
            if lower >= upper:
                raise ValueError(f"stops of joint {name}: lower {lower} must be less than upper {upper} [rad]")
        return self


class Bus(Section):
    """The CAN bus as python-can opens it."""

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[int, Field(gt=0)] = 1_000_000
    fd: bool = False
    """Frames go as CAN FD with bit-rate switch, where the interface has it; the load is counted as classical CAN's."""
    options: dict[str, str | int | FiniteFloat | bool] = {}
    """Further options of python-can's interface, such as data_bitrate or serial."""


def _parse_drive(keys: Any) -> Any:
    """Validate `link.joints[].drive` by its family's own model (entry-point group `armlink.drives`)."""
    if keys is None or isinstance(keys, Section):
        return keys
    if not isinstance(keys, dict) or not isinstance(keys.get("family"), str):
        raise ValueError("expected a mapping with the key `family`")
    return _drive_settings(keys["family"]).model_validate(keys)


@cache
def _drive_settings(family: str) -> type[Section]:
    found = load_contribution("armlink.drives", family)
    if found is None:
        known = ", ".join(sorted({point.name for point in contributions("armlink.drives")}))
        raise ValueError(f"drive family {family!r} is unknown; expected one of {known}")
    settings: type[Section] = found.settings
    return settings


U32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class DeviceIdentity(Section):
    """Which controller a joint must have (1018h:01 to :04); what is not stated is not compared."""

    vendor: U32 | None = None
    product: U32 | None = None
    revision: U32 | None = None
    serial: U32 | None = None


class LinkJoint(Section):
    """One joint controller: its drive and the limits that no frame may exceed."""

    name: JointName
    node: Annotated[int, Field(ge=1, le=127)] | None = None
    """Short for `drive: {family: canopen, node: …}`: CiA 402 with our own torque sensor object 2100h."""
    drive: Annotated[Any, BeforeValidator(_parse_drive)] = None
    """Family of the drive and the keys of that family (docs/drives.md)."""
    rated_torque: Positive
    """Torque that 1000 ‰ stands for (6076h) [N·m]."""
    max_torque: Positive
    """No command exceeds it [N·m]."""
    max_torque_rate: Positive = 200.0
    """[N·m/s]."""
    max_velocity: Positive = 1.0
    """[rad/s]."""
    identity: DeviceIdentity = DeviceIdentity()
    """Another controller than this one at the joint's node is refused at the start."""
    eds: str | None = None
    """Electronic data sheet of its controller (CiA 306), a path from the arm file; by default the one we ship."""
    bus: str = ""
    """Name of its bus in link.buses; empty: link.bus."""

    @model_validator(mode="after")
    def _one_drive(self) -> "LinkJoint":
        if self.node is None and self.drive is None:
            raise ValueError(f"{self.name}: give `node` or `drive: {{family: …}}`")
        if self.node is not None and self.drive is not None:
            raise ValueError(f"{self.name}: give `node` or `drive`, not both")
        return self

    @property
    def settings(self) -> Any:
        """Keys of its drive: the settings model of its family."""
        return self.drive if self.node is None else _parse_drive({"family": "canopen", "node": self.node})


class Park(Section):
    """Where the arm is stowed before drives that do not hold without their host lose their power."""

    pose: tuple[FiniteFloat, ...]
    """Position of every joint, in joint order [rad]: one in which the arm rests without power."""
    speed: Positive = 0.2
    """Speed of the fastest joint on the way there [rad/s]; no joint exceeds its max_velocity."""


class LinkSection(Section):
    """The link: bus, rate and joint controllers in joint order."""

    bus: Bus = Bus()
    buses: dict[str, Bus] = {}
    """Further buses by name, for joints that name one; ids are unique on each bus."""
    rate: Annotated[FiniteFloat, Field(gt=0, le=1000)] = 250.0
    """SYNC rate [Hz]."""
    deadline: Annotated[FiniteFloat, Field(ge=0.01, le=LONGEST_DEADLINE)] = 0.1
    """A joint that hears no command for this long goes to quick stop; a reading this old is a fault [s]."""
    joints: tuple[LinkJoint, ...]
    park: Park | None = None
    """Pose in which the arm is stowed; None: it is left where it stands."""
    keeper: bool = False
    """Drives that keep on with their last command are driven, with a process of their own that stops them when the host
    dies: it cannot stop them where the machine dies, or their cable."""

    @property
    def rated_torques(self) -> Array:
        """Rated torque of every joint (n,) [N·m]."""
        return np.array([joint.rated_torque for joint in self.joints])

    @model_validator(mode="after")
    def _park_names_every_joint(self) -> "LinkSection":
        if self.park is not None and len(self.park.pose) != len(self.joints):
            raise ValueError(
                f"park.pose has {len(self.park.pose)} positions, expected {len(self.joints)}: one for each joint"
            )
        return self

    @model_validator(mode="after")
    def _nodes_are_unique(self) -> "LinkSection":
        _no_twins([joint.name for joint in self.joints])
        _no_twins([f"{joint.settings.address}{joint.bus and ' on bus '}{joint.bus}" for joint in self.joints])
        for joint in self.joints:
            if joint.bus and joint.bus not in self.buses:
                known = ", ".join(self.buses) or "none"
                raise ValueError(f"{joint.name} is on bus {joint.bus!r}, which link.buses does not have ({known})")
        return self


class Tool(Section):
    """A body at the end of the arm: a gripper, a hand, a payload. Its exchange needs no new calibration."""

    mass: Positive
    """[kg]"""
    centre: tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    """Centre of mass in the frame that turns with the last joint, origin on its axis, z along it, x along `a` [m]."""
    mass_std: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    """Standard deviation of the mass [kg]."""
    centre_std: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    """Standard deviation of each coordinate of the centre [m]."""


def is_serial(text: str) -> bool:
    """Whether a serial number is one, and not what stands in an arm file before anybody has given one."""
    return text.strip().casefold() not in ("", "unknown", "fill-in")


class ArmFile(Section):
    """A whole arm file. `sweep`, `sim`, `daemon` hold the models that packages registered in `armlink.sections`."""

    name: Name
    serial: Name = "unknown"
    kinematics: Kinematics
    link: LinkSection | None = None
    tool: Tool | None = None
    sweep: Any = None
    sim: Any = None
    daemon: Any = None
    path: Path

    @model_validator(mode="after")
    def _name_is_no_folder(self) -> "ArmFile":
        for key, value in (("name", self.name), ("serial", self.serial)):
            if value in (".", ".."):
                raise ValueError(f"{key} is {value!r}, expected a name that can be part of a file name")
        return self

    @model_validator(mode="after")
    def _same_joints_everywhere(self) -> "ArmFile":
        described = [joint.name for joint in self.kinematics.joints]
        linked = [joint.name for joint in self.link.joints] if self.link else described
        if described and linked != described:
            raise ValueError(
                f"link.joints are {linked}, but kinematics.joints are {described}: give both the same names in "
                "the same order"
            )
        if described and self.link and self.link.park:
            for joint, position in zip(self.kinematics.joints, self.link.park.pose, strict=True):
                if not joint.lower <= position <= joint.upper:
                    where = f"which is outside the range {joint.lower:g} to {joint.upper:g} of this joint"
                    raise ValueError(f"link.park.pose: {joint.name} is at {position:g} rad, {where}")
        return self

    @property
    def has_serial(self) -> bool:
        """Whether the file tells the arm from others of its name."""
        return is_serial(self.serial)

    @property
    def has_geometry(self) -> bool:
        """Whether it is known where the joints are: of drives alone, all Denavit-Hartenberg rows are zero."""
        return not self.kinematics.joints or any(row.a or row.alpha or row.d for row in self.kinematics.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names from base to tip; empty where only a model file would tell."""
        return tuple(joint.name for joint in self.kinematics.joints or (self.link.joints if self.link else ()))

    @property
    def argument(self) -> str:
        """The arm as one types it in a command here: a bundled arm's name, else its path, quoted for a shell."""
        for name, path in bundled_arms().items():
            if path.resolve() == self.path:
                return name
        here = Path.cwd()
        return shlex.quote(str(self.path.relative_to(here) if self.path.is_relative_to(here) else self.path))

    @property
    def model_path(self) -> Path | None:
        """Absolute path of the URDF or MJCF file, or None."""
        return None if self.kinematics.model is None else (self.path.parent / self.kinematics.model).resolve()

    @cached_property
    def description_hash(self) -> str:
        """SHA-256 (hex) of the kinematics, model file included: results of another description are refused."""
        unset = {key for key in ("stops", "locked") if not getattr(self.kinematics, key)}  # as in older results
        content = json.dumps(self.kinematics.model_dump(mode="json", exclude=unset), sort_keys=True).encode()
        if self.model_path is not None:
            content += read_whole(self.model_path, MOST_TEXT)
        return hashlib.sha256(content).hexdigest()

    def require_link(self) -> LinkSection:
        """The link section; raises BadInput where the file has none."""
        if self.link is None:
            raise BadInput(
                f"{self.path}: key `link` is missing: this command needs the bus and the drives of the joints"
            )
        return self.link

    def require(self, kind: type[S], name: Literal["sweep", "sim"]) -> S:
        """The section `name`, typed; raises BadInput where the file has none."""
        section = getattr(self, name)
        if not isinstance(section, kind):
            raise BadInput(f"{self.path}: this command needs the section `{name}`: add it (docs/formats.md)")
        return section


def bundled_arms() -> dict[str, Path]:
    """Names and paths of the arm files that installed packages carry (entry-point group `armlink.arms`)."""
    folders = [files(point.value) for point in contributions("armlink.arms")]
    return {
        Path(str(entry)).stem: Path(str(entry))
        for folder in folders
        for entry in folder.iterdir()
        if str(entry).endswith(".yaml")
    }


def load_arm(arm: str | Path) -> ArmFile:
    """Load and validate the arm file at a path, or the bundled one of that name.

    Raises BadInput with one line that names the key, the value and what was expected.
    """
    path = bundled_arms().get(str(arm), Path(arm))
    if not path.is_file():
        raise BadInput(_no_arm_file(path))
    if path.suffix.lower() in MODEL_SUFFIXES:
        raise BadInput(
            f"{path} is a model, not an arm file: make an arm file from this model with `armlink new {path}`"
        )
    try:
        content = read_yaml(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from None
    if not isinstance(content, dict):
        kind = "nothing" if content is None else type(content).__name__
        raise BadInput(
            f"{path} contains {kind}: an arm file is a mapping with the keys `name`, `kinematics` and `link`"
        )
    return parse_arm(content, path)


def read_yaml(path: Path) -> Any:
    """Content of a YAML file; raises BadInput, in one line, where it is none, OSError where it cannot be read."""
    return parse_yaml(read_whole(path), path)


def _no_arm_file(path: Path) -> str:
    bundled, folder = sorted(bundled_arms()), path.parent
    beside = [str(each) for each in folder.glob("*.y*ml")] if folder.is_dir() else []
    close = suggest_key(str(path), [*bundled, *beside])
    hint = close if "mean" in close else ""
    if path.is_dir():
        return f"{path} is a folder: give the path of an arm file, or a bundled arm ({', '.join(bundled)})"
    return f"there is no arm file {path}: give a path, or a bundled arm ({', '.join(bundled)}){hint}"


def parse_arm(content: dict[str, Any], path: Path) -> ArmFile:
    """Validate an arm file's content; `path` is where it (would have) stood. Raises BadInput."""
    if "path" in content:
        raise BadInput(f"{path}: `path` is not a key of an arm file: remove it")
    content, section, model = _with_simulated_bus(dict(content), path), "", ArmFile
    try:
        for point in contributions("armlink.sections"):
            if content.get(point.name) is not None:
                section, model = point.name, point.load()
                content[section] = model.model_validate(content[section])
        section, model = "", ArmFile
        return ArmFile.model_validate({**content, "path": path.resolve()})
    except ValidationError as error:
        raise BadKeys(path, describe(error, section, model), describe_all(error, section, model)) from None


def _with_simulated_bus(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """The content, with the channel of a simulated bus that lies beside the arm file as an absolute path."""
    link = content.get("link")
    bus = link.get("bus") if isinstance(link, dict) else None
    if isinstance(link, dict) and isinstance(bus, dict) and bus.get("interface") == SIMULATED:
        beside = path.resolve().parent / str(bus.get("channel"))
        if os.path.isfile(beside):  # False for what cannot be a path, where Path raises
            content["link"] = {**link, "bus": {**bus, "channel": str(beside)}}
    return content


def _no_twins(values: list[Any]) -> None:
    twins = sorted({value for value in values if values.count(value) > 1})
    if twins:
        raise ValueError(f"{twins[0]!r} is given twice; names and nodes must be unique")
