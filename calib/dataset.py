"""The sweep data set: a directory with a manifest and one line per static reading, each on disk before the next."""

import errno
import hashlib
import json
import logging
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from armlink.arm_file import ArmFile, is_serial, load_arm
from armlink.content.atomic_file import part_of, write_whole
from armlink.content.file_content import MOST_TEXT, read_whole
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput, Refused
from armlink.key_errors import describe
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration
from calib.motion.static_reading import StaticReading, stack
from calib.plan.types import SweepPlan
from calib.records.file_lock import lock_file
from gcomp.arrays import Array

MANIFEST, LINES = "manifest.json", "readings.jsonl"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, ser_json_inf_nan="constants")


class Manifest(_Model):
    """Arm, load and controllers' calibration of a data set."""

    schema_: Literal["armlink.sweep/1"] = Field(default="armlink.sweep/1", alias="schema")
    arm: str
    serial: str
    description_hash: str
    arm_file: str
    """Path of the arm file that it was taken with."""
    names: tuple[str, ...]
    reference_mass: float
    """Reference mass attached during this pass [kg]; 0 for none."""
    rated_torque: tuple[float, ...]
    """[N·m]"""
    installed_gain: tuple[float, ...]
    """Torque gains that the controllers applied while it was taken: readings are (v − offset) / gain."""
    installed_offset: tuple[float, ...]
    """[N·m]"""
    drives: Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)] = ()
    """Serial numbers of the drives, joint by joint, empty for one that tells none; () if none does."""
    bus: Annotated[str, Field(exclude_if=lambda value: not value)] = ""
    """The bus that was given, instead of the arm file's; empty if none was."""
    created: AwareDatetime
    software: str

    @classmethod
    def of(
        cls,
        arm_file: ArmFile,
        reference_mass: float,
        installed: Sequence[TorqueCalibration[float]] | None = None,
        drives: Sequence[str] = (),
        bus: str | None = None,
    ) -> Self:
        """The manifest of a new data set of this arm; `installed` is what the controllers hold, by default nothing."""
        pairs = installed or [UNCALIBRATED] * len(arm_file.joint_names)
        return cls(
            arm=arm_file.name,
            serial=arm_file.serial,
            description_hash=arm_file.description_hash,
            arm_file=str(arm_file.path),
            names=arm_file.joint_names,
            reference_mass=reference_mass,
            rated_torque=tuple(arm_file.require_link().rated_torques.tolist()),
            installed_gain=tuple(each.gain for each in pairs),
            installed_offset=tuple(each.offset for each in pairs),
            drives=tuple(drives) if any(drives) else (),
            bus=bus or "",
            created=datetime.now(UTC).replace(microsecond=0),
            software=f"armlink {version('armlink')}",
        )

    @property
    def installed(self) -> TorqueCalibration[Array]:
        """Calibration that the controllers held while the data was taken (n,)."""
        return TorqueCalibration(np.array(self.installed_gain), np.array(self.installed_offset))


class PlanLine(_Model):
    """The plan as run, written as soon as the scout has determined the bias torques."""

    kind: Literal["plan"] = "plan"
    plan: SweepPlan
    resolution: tuple[float, ...]
    """Smallest step seen in each joint's position reading [rad]."""


class StallLine(_Model):
    """The joints had to be stopped, were enabled again, and the interrupted reading was repeated."""

    kind: Literal["stall"] = "stall"
    t: float
    """Link time of the last sample before it [s]."""
    late_ms: float | None
    """How late the host was [ms]; None if it was not the host."""
    reading: str
    """Sweep and number of the reading that was interrupted."""
    reason: str
    contact: Annotated[bool, Field(exclude_if=lambda value: not value)] = False
    """A creeping joint met something: its sweep was not repeated."""


Line = StaticReading | PlanLine | StallLine
_LINE: TypeAdapter[Line] = TypeAdapter(
    Annotated[Line, Field(discriminator="kind")], config=ConfigDict(ser_json_inf_nan="constants")
)


def drives_of(data: Sequence["SweepData"]) -> tuple[str, ...]:
    """Serial numbers of the drives that data sets were taken on; raises Refused where they are of two arms."""
    told = [each for each in data if each.manifest.drives]
    for each in told[1:]:
        if not {*each.manifest.drives} & {*told[0].manifest.drives} - {""}:
            raise Refused(f"{told[0].path} and {each.path} have no drive in common, so they come from two arms")
    return told[-1].manifest.drives if told else ()


def encode(line: Line) -> bytes:
    return _LINE.dump_json(line) + b"\n"


@dataclass(frozen=True, eq=False)
class SweepData:
    path: Path
    manifest: Manifest
    readings: tuple[StaticReading, ...]
    plan: SweepPlan | None
    """The plan as run; None if the scout was not finished."""
    resolution: Array
    """Smallest step seen in each joint's position reading (n,) [rad]; 0 if unknown."""
    digest: str = field(repr=False)
    """SHA-256 (hex) of the lines read."""
    stalls: tuple[StallLine, ...] = ()
    """Interruptions, in their order."""

    @property
    def complete(self) -> bool:
        return self.plan is not None and len(self.readings) >= self.plan.readings

    @property
    def contacts(self) -> tuple[StallLine, ...]:
        """Creeps that ended because the joint met something."""
        return tuple(stall for stall in self.stalls if stall.contact)

    @property
    def creeps(self) -> bool:
        """Whether it is of creep sweeps instead of steps at rest."""
        return self.plan is not None and any(sweep.speed is not None for sweep in self.plan.sweeps)

    @property
    def unsettled(self) -> tuple[StaticReading, ...]:
        """Readings that were taken before the arm was at rest."""
        return tuple(reading for reading in self.readings if not reading.settled)

    def require(self, arm_file: ArmFile) -> Self:
        """This data set; raises Refused, naming the difference, if it is of another arm.

        One that was taken before the arm's file had a serial number is of the arm that has one now; its drives tell
        whether that is so when it is written.
        """
        named = is_serial(self.manifest.serial)
        differing = {
            "arm": (self.manifest.arm, arm_file.name),
            "serial": (self.manifest.serial if named else arm_file.serial, arm_file.serial),
            "description": (self.manifest.description_hash[:12], arm_file.description_hash[:12]),
        }
        for what, (ours, wanted) in differing.items():
            if ours != wanted:
                raise Refused(
                    f"{self.path}: {what} is {ours}, but must be {wanted}: the data set is of another arm or arm file"
                )
        return self

    def load_arm(self, override: str | None = None) -> ArmFile:
        """The arm file that it was taken with, or `override`; raises BadInput, Refused on another arm."""
        path = Path(self.manifest.arm_file)
        found = override or (str(path) if path.is_file() else self.manifest.arm)
        arm_file = load_arm(found)
        self.require(arm_file)
        return arm_file

    def array(self, name: str) -> Array:
        """One field of all readings, (K,) or (K, n), as numbers."""
        return stack(self.readings, name).astype(float)


def load_data(path: Path) -> SweepData:
    """Read a data set; an incomplete last line is left out. Raises BadInput naming the file and line."""
    with memory_budget(path):
        return _loaded(path)


def _loaded(path: Path) -> SweepData:
    manifest = _read_manifest(path)
    content = (path / LINES).read_bytes() if (path / LINES).is_file() else b""
    whole = content[: content.rfind(b"\n") + 1]
    readings: list[StaticReading] = []
    stalls: list[StallLine] = []
    plan, resolution = None, np.zeros(len(manifest.names))
    for line in _parse(whole.splitlines(), path / LINES):
        if isinstance(line, PlanLine):
            plan, resolution = line.plan, np.array(line.resolution)
        elif isinstance(line, StallLine):
            stalls.append(line)
        else:
            _check_width(line, len(manifest.names), path)
            readings.append(line)
    digest = hashlib.sha256(whole).hexdigest()
    return SweepData(path, manifest, tuple(readings), plan, resolution, digest, tuple(stalls))


def earlier_passes(data: SweepData) -> list[SweepData]:
    """Whole data sets of the same arm and drives that were begun before this one, beside it or in the present folder;
    the oldest first."""
    ours, found = data.manifest, dict[Path, SweepData]()
    for file in (*data.path.parent.glob(f"*/{MANIFEST}"), *Path().glob(f"*/{MANIFEST}")):
        path = file.parent
        try:
            theirs = _read_manifest(path)
            same = all(getattr(theirs, key) == getattr(ours, key) for key in ("arm", "serial", "description_hash"))
            if same and theirs.drives == ours.drives and theirs.created <= ours.created:
                found.setdefault(path.resolve(), load_data(path))
        except BadInput:  # of another version, or not a data set at all
            continue
    found.pop(data.path.resolve(), None)
    return sorted((each for each in found.values() if each.complete), key=lambda each: each.manifest.created)


def require_vacant(path: Path, resume: bool = False) -> None:
    """Raise BadInput unless a new data set can begin at `path` or, with `resume`, one there can be continued."""
    if resume:
        _read_manifest(path)
    elif path.exists() and (not path.is_dir() or any(each != part_of(path / MANIFEST) for each in path.iterdir())):
        raise BadInput(f"{path} is not empty: choose another directory, or continue the sweep there with `--resume`")


def new_folder(path: Path) -> Path:
    """The path, or one beside it with a number, at which a data set can begin."""
    names = (path, *(path.with_name(f"{path.name}-{number}") for number in range(2, 1000)))
    return next((each for each in names if not each.exists()), path)


class DataWriter:
    """Appends to a data set; each line is on disk when `append` returns. A context manager."""

    def __init__(self, path: Path, manifest: Manifest, resume: bool = False) -> None:
        """Make the directory or, with `resume`, continue the one there; raises BadInput if that is impossible."""
        require_vacant(path, resume)
        if resume:
            _require_same(_read_manifest(path), manifest, path)
        else:
            path.mkdir(parents=True, exist_ok=True)
            write_whole(path / MANIFEST, manifest.model_dump_json(by_alias=True, indent=1))
        self._file = (path / LINES).open("ab+", buffering=0)
        try:
            lock_file(self._file.fileno(), str(path))
        except BadInput:
            self._file.close()
            raise
        self._file.seek(0)
        content = self._file.read()
        self._file.truncate(content.rfind(b"\n") + 1)  # a torn line goes
        _keep_names(path)

    def append(self, line: Line) -> None:
        """Write one line and wait until it is on disk; raises BadInput if the disk is full or fails."""
        content = encode(line)
        try:
            if self._file.write(content) < len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(self._file.fileno())
        except OSError as error:
            raise BadInput(
                f"{self._file.name}: {error.strerror}: the last reading was not saved, the readings before "
                "it were: free or repair the disk, then continue with `--resume`"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _keep_names(path: Path) -> None:
    """Wait until a directory's entries and its own name are on disk, so that a power cut cannot lose them."""
    for folder in (path, path.parent):
        opened = os.open(folder, os.O_RDONLY)
        os.fsync(opened)
        os.close(opened)


def _read_manifest(path: Path) -> Manifest:
    file = path / MANIFEST
    if not file.is_file():
        raise BadInput(f"{path}: there is no sweep data set, since {MANIFEST} is missing")
    try:
        return Manifest.model_validate(json.loads(read_whole(file, MOST_TEXT)))
    except ValidationError as error:
        raise BadInput(f"{file}: {describe(error)}") from None
    except (ValueError, RecursionError, OSError) as error:
        raise BadInput(f"{file}: not readable as JSON: {error}") from None


def _parse(lines: Sequence[bytes], file: Path) -> Iterator[Line]:
    for number, line in enumerate(lines, start=1):
        try:
            yield _LINE.validate_json(line)
        except ValidationError as error:
            raise BadInput(f"{file}: line {number}: {describe(error)}") from None


def _check_width(reading: StaticReading, n: int, path: Path) -> None:
    for key in ("servo", "position", "position_std", "torque", "torque_std", "motor_torque"):
        if len(getattr(reading, key)) != n:
            raise BadInput(
                f"{path}: sweep {reading.sweep}, reading {reading.index}: {key} must have one value for each "
                f"joint ({n})"
            )


def _require_same(found: Manifest, wanted: Manifest, path: Path) -> None:
    for key in ("arm", "serial", "description_hash", "reference_mass", "installed_gain", "installed_offset"):
        before, now = getattr(found, key), getattr(wanted, key)
        if before != now:
            raise Refused(
                f"{path}: {key} was {before}, but now it is {now}: resume with the same arm and the same mass"
            )


log = logging.getLogger(__name__)


def data_sets(given: Sequence[Path | SweepData]) -> list[SweepData]:
    """Each data set, read from its folder where it is given as one; a warning for each that was ended early.

    Raises BadInput where one cannot be read, or where two hold the same readings, which would count twice.
    """
    found = [each if isinstance(each, SweepData) else load_data(each) for each in given]
    for number, each in enumerate(found):
        twin = next((other for other in found[:number] if other.readings and other.digest == each.digest), None)
        if twin is not None:
            raise BadInput(
                f"{each.path} has the same readings as {twin.path}, which would count twice: give one of the two"
            )
        if each.readings and (missing := _missing(each)):
            log.warning(
                "%s ended before %s: the fit uses the readings so far; to continue: armlink sweep %s --out %s --resume",
                *(each.path, missing, each.manifest.arm_file, each.path),
            )
    return found


def all_creep(data: Sequence[SweepData]) -> bool:
    """Whether the data sets are creep sweeps; raises BadInput where some are and some are not."""
    if any(each.creeps for each in data) and (other := next((each for each in data if not each.creeps), None)):
        raise BadInput(
            f"{other.path} holds steps at rest, but the other directories hold creep sweeps: give only one kind"
        )
    return bool(data) and data[0].creeps


def labels(paths: Sequence[Path]) -> list[str]:
    """Names of the data of these paths in records and findings: last names, or the paths where two have the same."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def digests(data: Sequence[SweepData]) -> dict[str, str]:
    """Label → SHA-256 of each data set, as records name their sources."""
    return dict(zip(labels([each.path for each in data]), [each.digest for each in data], strict=True))


def _missing(data: SweepData) -> str:
    """The first part that the sweep of a data set did not reach, in words; empty if it is whole."""
    if data.plan is None:
        return "its first sweep"
    made = Counter(reading.sweep for reading in data.readings)
    met = {stall.reading for stall in data.contacts}  # of creeping joints: not repeated
    for sweep in data.plan.sweeps:
        if sweep.name not in met and made[sweep.name] < (1 if sweep.speed else sweep.readings):
            return f"the end of sweep {sweep.name}"
    return ""
