"""Calibration and gravity records of one arm, with their covariance and provenance."""

import hashlib
from collections.abc import Sequence, Set
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import (
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    PositiveFloat,
    ValidationError,
    model_validator,
)

from armlink.arm_file import ArmFile, Tool
from armlink.content.yaml_text import yaml_document
from armlink.errors import BadInput, Refused
from armlink.key_errors import describe
from armlink.torque_calibration import UNKNOWN, TorqueCalibration
from calib.arm.kinematics import gcomp_arm, tool_covariance, tool_moments
from gcomp.arrays import Array

Matrix = tuple[tuple[FiniteFloat, ...], ...]
Parameter = Literal["gain", "offset", "position_gain", "position_offset"]
PARAMETERS: tuple[Parameter, ...] = ("gain", "offset", "position_gain", "position_offset")


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ArmRecord(_Frozen):
    """Common part of all records: arm, date, software, sources. Records never change."""

    kind: str
    schema_version: int = 1
    arm: str
    serial: str
    description_hash: str
    """SHA-256 of the arm's kinematics; the numbers are valid for this description only."""
    created: AwareDatetime
    """With fractions of a second, so that records made within one second keep their order."""
    software: str
    sources: dict[str, str] = {}
    """Name and SHA-256 of every data set and recording used."""
    confirmed_by: str | None = None
    """A user's name, or the policy that applied it automatically; None if not confirmed."""
    parent: str | None = None
    """Id of the record that this one replaced."""
    note: str = ""

    SCHEMA: ClassVar[int] = 1

    @property
    def data(self) -> set[str]:
        """Digests of the data that it comes from; other records, such as gravity's, are named by their ids."""
        return {digest for name, digest in self.sources.items() if not name.endswith(digest)}

    def is_fitted_to(self, digests: Set[str]) -> bool:
        """Whether it comes from some of these data sets: for it they are not held out."""
        return not digests.isdisjoint(self.sources.values())

    @property
    def id(self) -> str:
        """Eight hex digits of the content's SHA-256; as a number it fits 32 bits, as a controller keeps it."""
        return digest_id(self.model_dump_json())

    @property
    def number(self) -> int:
        """`id` as the UNSIGNED32 that a controller keeps beside its gain and offset."""
        return number_of(self.id)

    def require(self, arm: ArmFile) -> Self:
        """This record, if it is of this arm; else raises Refused with one line that names the difference."""
        differing = {
            "arm": (self.arm, arm.name),
            "serial": (self.serial, arm.serial),
            "description": (self.description_hash[:12], arm.description_hash[:12]),
            "schema version": (self.schema_version, self.SCHEMA),
        }
        for what, (ours, wanted) in differing.items():
            if ours != wanted:
                raise Refused(
                    f"record {self.id}: {what} is {ours}, but must be {wanted}: the record belongs to another arm"
                )
        return self

    def to_yaml(self) -> str:
        """The record as YAML, with its id as check sum."""
        return yaml_document({"id": self.id, **self.model_dump(mode="json")})


class Discrepancy(_Frozen):
    """Remaining disagreement of one joint's calibrated torque with the gravity model, as a field over position.

    Calibrated torque (v - offset)/gain minus model torque, without noise, is at poses q, q' a Gaussian field of mean 0
    and covariance level² exp(-|q - q'|²/(2 length²)), where |q - q'| is the root of the sum over all joints of
    (2 sin((q_l - q'_l)/2))² [rad]. More readings of one pose do not make it smaller. It holds for the record's gains
    and offsets with the mass moments of the same fit, and comes on top of their covariances (docs/theory.md, 4.6).
    """

    level: Annotated[FiniteFloat, Field(ge=0)]
    """Standard deviation over the poses of the joints' range [N·m]."""
    level_std: Annotated[FiniteFloat, Field(ge=0)]
    """Standard deviation of `level` [N·m]."""
    length: PositiveFloat
    """Distance in position over which it is alike [rad]."""


class MotorTorque(_Frozen):
    """Friction of a joint whose torque is a motor current, and what temperature does to the gain.

    v = gain (τ + s (coulomb + load |τ|)(1 + s·asymmetry) + viscous q̇) + offset, with s the direction of motion.
    """

    coulomb: tuple[FiniteFloat, FiniteFloat]
    """Value and standard deviation [N·m], as the others here."""
    load: tuple[FiniteFloat, FiniteFloat]
    """Friction per transmitted torque [1]."""
    viscous: tuple[FiniteFloat, FiniteFloat]
    """[N·m·s/rad]"""
    asymmetry: tuple[FiniteFloat, FiniteFloat]
    """Half the difference of the two directions' friction over their mean [1]."""
    temperature: FiniteFloat | None = None
    """Temperature of the drive at which the gain holds [°C]; None where none was logged."""
    gain_per_kelvin: tuple[FiniteFloat, FiniteFloat] | None = None
    """Relative change of the gain per kelvin."""


class JointCalibration(_Frozen):
    """Sensor parameters of one joint: v = gain·τ + offset, θ = position_gain·φ + position_offset.

    A parameter is None if the data could not determine it; `not_identifiable` then has the reason.
    """

    name: str
    gain: FiniteFloat | None
    offset: FiniteFloat | None
    """[N·m]"""
    position_gain: FiniteFloat | None
    position_offset: FiniteFloat | None
    """[rad]"""
    not_identifiable: dict[Parameter, str] = {}
    residual_std: FiniteFloat | None = None
    """Standard deviation of the fit's torque residual at one stop [N·m]."""
    discrepancy: Annotated[Discrepancy | None, Field(exclude_if=lambda value: value is None)] = None
    """Doubt of the fit beyond its covariance; None, and not written, in records made without an estimate of it, so
    that these keep their content and with it their id."""
    motor: Annotated[MotorTorque | None, Field(exclude_if=lambda value: value is None)] = None
    """Friction of a joint whose torque is a motor current; None, and not written, for the others."""

    @model_validator(mode="after")
    def _none_has_a_reason(self) -> Self:
        missing = {parameter for parameter in PARAMETERS if getattr(self, parameter) is None}
        if missing != set(self.not_identifiable):
            raise ValueError(
                f"joint {self.name}: {sorted(missing)} have no value, but {sorted(self.not_identifiable)} "
                "have a reason: give a reason for each missing value, and for no other value"
            )
        if self.gain == 0.0 or self.position_gain == 0.0:
            raise ValueError(f"joint {self.name}: the gain is 0, which no sensor has")
        return self

    def torque_calibration(self, missing: TorqueCalibration[float] = UNKNOWN) -> TorqueCalibration[float]:
        """Gain and offset of the torque sensor; those of `missing` if they are not identifiable."""
        return TorqueCalibration(
            missing.gain if self.gain is None else self.gain, missing.offset if self.offset is None else self.offset
        )


class HeldOutJoint(_Frozen):
    """Errors of held-out readings of one joint, of the new record against the one before."""

    joint: str
    ratio: FiniteFloat
    """RMS, new over old."""
    deviations: FiniteFloat
    """Standard errors by which the new mean square is larger; negative where it is smaller."""


class HeldOut(_Frozen):
    """How a record predicts readings that were left out of its fit, against the record that it is to replace."""

    against: str
    """Id of the record before."""
    joints: tuple[HeldOutJoint, ...] = ()
    """Those with readings enough; none where the record before was fitted to the same readings, which judge nothing, or
    where a sensor was exchanged."""


class CalibrationRecord(ArmRecord):
    """Sensor gains and offsets of all joints, base to tip."""

    kind: Literal["calibration"] = "calibration"
    joints: Annotated[tuple[JointCalibration, ...], Field(min_length=1)]
    drives: Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)] = ()
    """Serial numbers of the drives that it was measured on, joint by joint, empty for one that tells none; not written
    in records made without them, so that these keep their id."""
    covariance_of: tuple[str, ...] = ()
    """Names of the rows and columns of `covariance`: "joint_1.gain", …; only parameters that were estimated."""
    covariance: Matrix = ()
    held_out: Annotated[HeldOut | None, Field(exclude_if=lambda value: value is None)] = None
    """Proof of a record that is to be written to controllers; None, and not written, in others, which keep their id."""

    @model_validator(mode="after")
    def _covariance_fits(self) -> Self:
        _square(self.covariance, len(self.covariance_of), "covariance_of")
        known = {f"{joint.name}.{parameter}" for joint in self.joints for parameter in PARAMETERS}
        for name in self.covariance_of:
            if name not in known:
                raise ValueError(f"covariance_of: {name!r} is not a parameter of this record")
        return self

    def values(self, parameter: Parameter, missing: float = np.nan) -> Array:
        """One parameter of all joints (n,); `missing` for those not identifiable."""
        found = [getattr(joint, parameter) for joint in self.joints]
        return np.array([missing if value is None else value for value in found])

    def torque_calibration(
        self, missing: TorqueCalibration[float] | TorqueCalibration[Array] = UNKNOWN
    ) -> TorqueCalibration[Array]:
        """Gains and offsets of all torque sensors (n,); those of `missing` if they are not identifiable."""
        gain, offset = self.values("gain"), self.values("offset")
        return TorqueCalibration(
            np.where(np.isnan(gain), missing.gain, gain), np.where(np.isnan(offset), missing.offset, offset)
        )

    def angle(self, reading: Array) -> Array:
        """Joint angles (…, n) [rad] from position readings; a sensor without a calibration counts as exact."""
        return reading * self.values("position_gain", 1.0) + self.values("position_offset", 0.0)

    def is_installed(self, held: Sequence[TorqueCalibration[float]]) -> bool:
        """Whether controllers that hold `held`, joint by joint, hold this record, as REAL32 keeps it."""
        pairs = zip(self.joints, held, strict=True)
        return all(joint.torque_calibration(now).matches(now) for joint, now in pairs)

    def discrepancy(self, key: Literal["level", "level_std", "length"], missing: float = 0.0) -> Array:
        """One number of the discrepancy of all joints (n,); `missing` where the record has none."""
        found = [each.discrepancy for each in self.joints]
        return np.array([missing if each is None else getattr(each, key) for each in found])

    def std(self, parameter: Parameter) -> Array:
        """Standard deviations of one parameter of all joints (n,); NaN for those not estimated."""
        place = {name: index for index, name in enumerate(self.covariance_of)}
        names = [f"{joint.name}.{parameter}" for joint in self.joints]
        return np.array([self.covariance[place[n]][place[n]] ** 0.5 if n in place else np.nan for n in names])


class GravityRecord(ArmRecord):
    """Gravity parameters β = (n_1x, n_1y, …, n_nx, n_ny) [kg·m] (docs/theory.md, section 2) and their covariance."""

    kind: Literal["gravity"] = "gravity"
    names: Annotated[tuple[str, ...], Field(min_length=1)]
    """Joint names, base to tip."""
    beta: tuple[FiniteFloat, ...]
    """(2n,) [kg·m]; 0 for those not identifiable."""
    covariance: Matrix
    """(2n, 2n) [kg²·m²]; 0 for those not identifiable."""
    identifiable: tuple[bool, ...]
    """(2n,)"""
    gravity: Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]
    """Acceleration of gravity used, base frame [m/s²]; the scale of β depends on it."""
    calibration: str | None = None
    """Id of the calibration record whose sensors measured it."""
    tool: Annotated[Tool | None, Field(exclude_if=lambda value: value is None)] = None
    """The tool that the arm carried then, as its arm file had it; its moments are in β."""

    def carrying(self, arm: ArmFile) -> "GravityRecord":
        """This record with the tool that the arm carries now in place of the one of then; raises Refused as require."""
        self.require(arm)
        if self.tool == arm.tool:
            return self
        kinematics = gcomp_arm(arm)
        beta = np.array(self.beta) - tool_moments(kinematics, self.tool) + tool_moments(kinematics, arm.tool)
        doubt = tool_covariance(kinematics, self.tool) + tool_covariance(kinematics, arm.tool)
        covariance = matrix(np.array(self.covariance) + doubt)
        return self.model_copy(update={"beta": tuple(beta.tolist()), "covariance": covariance, "tool": arm.tool})

    @model_validator(mode="after")
    def _sizes_fit(self) -> Self:
        size = 2 * len(self.names)
        for key in ("beta", "identifiable"):
            if len(getattr(self, key)) != size:
                raise ValueError(f"{key} has {len(getattr(self, key))} values, expected {size} (two for each joint)")
        _square(self.covariance, size, "twice the joints")
        return self


def digest_id(body: str) -> str:
    """Id of a record by its JSON, as it was stored."""
    return hashlib.sha256(body.encode()).hexdigest()[:8]


def number_of(record_id: str) -> int:
    """Id of a record as a number (32 bits)."""
    return int(record_id, 16)


def provenance(arm: ArmFile, sources: dict[str, str] | None = None, created: datetime | None = None) -> dict[str, Any]:
    """The identity part of a new record of this arm, as keyword arguments for its class."""
    return {
        "arm": arm.name,
        "serial": arm.serial,
        "description_hash": arm.description_hash,
        "created": created or datetime.now(UTC),
        "software": f"armlink {version('armlink')}",
        "sources": sources or {},
    }


def matrix(values: npt.ArrayLike) -> Matrix:
    """A (P, P) array as nested tuples, made exactly symmetric."""
    array = np.asarray(values, dtype=float)
    return tuple(tuple(row) for row in ((array + array.T) / 2).tolist())


def parse_record(content: Any, origin: str) -> CalibrationRecord | GravityRecord:
    """A record of either kind from a mapping; its key `id`, if present, must match. Raises BadInput with one line."""
    kinds: dict[Any, type[CalibrationRecord] | type[GravityRecord]] = {
        "calibration": CalibrationRecord,
        "gravity": GravityRecord,
    }
    kind = content.get("kind") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise BadInput(f"{origin}: `kind` is {kind!r}, expected calibration or gravity")
    body = {key: value for key, value in content.items() if key != "id"}
    try:
        record = kinds[kind].model_validate(body)
    except ValidationError as error:
        raise BadInput(f"{origin}: {describe(error)}") from None
    if content.get("id", record.id) != record.id:
        raise BadInput(
            f"{origin}: the content was changed, since its id is {content['id']}, but the content gives {record.id}"
        )
    return record


def _square(rows: Sequence[Sequence[float]], size: int, of: str) -> None:
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"covariance: expected {size} × {size} ({of}), got {len(rows)} rows")
