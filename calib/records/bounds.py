"""Bounds of every number in a record: beyond them it is of no working arm, and is never in force.

`RecordStore` asks here whenever a record becomes current, is imported, or is taken out to be used; listing, comparing
and exporting records asks for nothing. What a record may change on the controllers is judged apart, by
`calib.install.plausibility`.
"""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from armlink.arm_file import STANDARD_GRAVITY, ArmFile
from armlink.errors import Refused
from armlink.torque_calibration import GAIN_RANGE, MOST_OFFSET
from calib.records.records import PARAMETERS, CalibrationRecord, GravityRecord, JointCalibration, Parameter

R = TypeVar("R", bound=CalibrationRecord | GravityRecord)

EARLIEST = datetime(1984, 1, 1, tzinfo=UTC)
"""Day 0 of CANopen's time of day (CiA 301, TIME_OF_DAY)."""
LATEST = datetime.fromtimestamp(2**32 - 1, UTC)
"""Last second that the date of a calibration, UNSIGNED32 seconds since 1970, can tell a controller."""
CLOCK_TOLERANCE = timedelta(hours=26)
"""How far the clocks of two machines that share records may differ: local time of UTC+14 and of UTC-12, both taken for
UTC, are the furthest apart (IANA time zone database)."""
LARGEST_MASS_MOMENT = 1e5
"""Of any link where the arm file tells no torque [kg·m]: twice 11 t of arm and 2.3 t of load, all at 3.7 m (FANUC
M-2000iA/2300, data sheet)."""
BALANCED = 10.0
"""Gravity torque of an arm over the largest torque of its drives, at most [1]: a choice, springs and counterweights
then carry nine tenths."""
LARGEST_GRAVITY = 25.0
"""[m/s²]: the strongest of the planets, Jupiter's, is 24.8 (NASA planetary fact sheet)."""
TURN = 2 * np.pi
"""Largest position offset [rad]: a sensor of one turn cannot be further off."""
LARGEST_LENGTH = 100.0
"""Of a discrepancy [rad]; the fit gives 0.18 to 5 (`calib.fit.examination`)."""
LARGEST_FRICTION = 10.0
"""Friction over rated torque, and friction per transmitted torque, at most [1]: beyond 1 a gear is self-locking;
tenfold for values that sweeps hardly determine."""
SLOWEST_RATED = 0.01
"""Velocity at which viscous friction alone may be the rated torque [rad/s]: slower than any creep sweep."""
LARGEST_ASYMMETRY = 100.0
"""Half the difference of the two directions' friction over their mean [1]: 1 where one has none; more where the mean
is hardly determined."""
TEMPERATURES = (-273.15, 1000.0)
"""Of a drive [°C]: absolute zero; beyond the Curie temperature of its magnets (SmCo, 800 °C)."""
LARGEST_WARMING = 1.0
"""Relative change of a gain per kelvin, at most [1/K]: copper has 0.004, magnets -0.002."""
DOUBT = 1e3
"""Standard deviation of a value over its bound, at most [1]: for what the data hardly determine."""
CORRELATION_ROUNDING = 1e-6
"""Relative room of a covariance beyond perfect correlation [1]."""


class BoundedValue(NamedTuple):
    """A number of a record with the range that it must lie in."""

    what: str
    value: float
    lower: float
    upper: float
    unit: str = ""


def require_sound(record: R, arm: ArmFile, now: datetime | None = None) -> R:
    """This record, if every number in it can be of a working arm; raises Refused with the first that cannot.

    With `now`, when it becomes current, it must not have been made after that either; the date of one that is in force
    already is not held against a clock that may have been set back since.
    """
    joints = record.joints if isinstance(record, CalibrationRecord) else record.names
    if arm.joint_names and len(joints) != len(arm.joint_names):
        raise _unsound(record, f"it has {len(joints)} joints, but the arm has {len(arm.joint_names)}")
    _require_date(record, now)
    values = _of_calibration(record, arm) if isinstance(record, CalibrationRecord) else _of_gravity(record, arm)
    for each in values:
        if not each.lower <= each.value <= each.upper:
            unit = each.unit and f" {each.unit}"
            usual = f"{each.lower:.6g} to {each.upper:.6g}"
            raise _unsound(record, f"{each.what} is {each.value:.6g}{unit}; working arms have {usual}")
    return record


def _unsound(record: R, why: str) -> Refused:
    return Refused(f"record {record.id}: {why}: calibrate again, or go back to another record")


def _require_date(record: R, now: datetime | None) -> None:
    if not EARLIEST <= record.created <= LATEST:
        raise _unsound(record, f"created is {record.created:%Y-%m-%d}, expected {EARLIEST:%Y} to {LATEST:%Y}")
    if now is not None and record.created > now + CLOCK_TOLERANCE:
        raise Refused(
            f"record {record.id} was created on {record.created:%Y-%m-%d %H:%M %Z}, but the clock of this machine says "
            f"{now:%Y-%m-%d %H:%M %Z}: a record over 26 h in the future cannot become current: correct the wrong clock"
        )


def _of_calibration(record: CalibrationRecord, arm: ArmFile) -> Iterator[BoundedValue]:
    rated = [MOST_OFFSET] * len(record.joints) if arm.link is None else arm.link.rated_torques.tolist()
    bounds: dict[str, float] = {}
    for joint, torque in zip(record.joints, rated, strict=True):
        ranges: dict[Parameter, tuple[float, float, str]] = {
            "gain": (*GAIN_RANGE, ""),
            "offset": (-torque, torque, "N·m"),
            "position_gain": (*GAIN_RANGE, ""),
            "position_offset": (-TURN, TURN, "rad"),
        }
        for parameter in PARAMETERS:
            lower, upper, unit = ranges[parameter]
            bounds[f"{joint.name}.{parameter}"] = upper
            value = getattr(joint, parameter)
            if value is not None:
                yield BoundedValue(f"{joint.name}: {parameter}", value, lower, upper, unit)
        yield from _of_joint(joint, torque)
    yield from _of_covariance(record.covariance, [(name, bounds[name]) for name in record.covariance_of])


def _of_joint(joint: JointCalibration, rated: float) -> Iterator[BoundedValue]:
    """Scatter, discrepancy and motor: all that a calibration has of a joint beside gains and offsets."""
    if joint.residual_std is not None:
        yield BoundedValue(f"{joint.name}: residual_std", joint.residual_std, 0.0, DOUBT * rated, "N·m")
    found = joint.discrepancy
    if found is not None:
        yield BoundedValue(f"{joint.name}: discrepancy.level", found.level, 0.0, rated, "N·m")
        yield BoundedValue(f"{joint.name}: discrepancy.level_std", found.level_std, 0.0, DOUBT * rated, "N·m")
        yield BoundedValue(f"{joint.name}: discrepancy.length", found.length, 0.0, LARGEST_LENGTH, "rad")
    motor = joint.motor
    if motor is None:
        return
    pairs = [
        ("coulomb", motor.coulomb, LARGEST_FRICTION * rated, "N·m"),
        ("load", motor.load, LARGEST_FRICTION, ""),
        ("viscous", motor.viscous, rated / SLOWEST_RATED, "N·m·s/rad"),
        ("asymmetry", motor.asymmetry, LARGEST_ASYMMETRY, ""),
    ]
    if motor.gain_per_kelvin is not None:
        pairs.append(("gain_per_kelvin", motor.gain_per_kelvin, LARGEST_WARMING, "1/K"))
    for key, (value, std), largest, unit in pairs:
        yield BoundedValue(f"{joint.name}: motor.{key}", value, -largest, largest, unit)
        yield BoundedValue(f"{joint.name}: standard deviation of motor.{key}", std, 0.0, DOUBT * largest, unit)
    if motor.temperature is not None:
        yield BoundedValue(f"{joint.name}: motor.temperature", motor.temperature, *TEMPERATURES, "°C")


def _of_gravity(record: GravityRecord, arm: ArmFile) -> Iterator[BoundedValue]:
    largest = LARGEST_MASS_MOMENT
    if arm.link is not None:
        torque = max(max(joint.max_torque, joint.rated_torque) for joint in arm.link.joints)
        largest = BALANCED * torque / math.hypot(*STANDARD_GRAVITY)
    names = [f"{name}: {axis} of the mass moment" for name in record.names for axis in ("x", "y")]
    for name, value in zip(names, record.beta, strict=True):
        yield BoundedValue(name, value, -largest, largest, "kg·m")
    yield BoundedValue("gravity", math.hypot(*record.gravity), 0.0, LARGEST_GRAVITY, "m/s²")
    yield from _of_covariance(record.covariance, [(name, largest) for name in names])


def _of_covariance(rows: npt.ArrayLike, named: list[tuple[str, float]]) -> Iterator[BoundedValue]:
    """Standard deviations up to DOUBT times each value's bound, and correlations of at most 1."""
    if not named:
        return
    covariance = np.asarray(rows, dtype=float)
    variances = np.diag(covariance)
    for (name, bound), variance in zip(named, variances.tolist(), strict=True):
        yield BoundedValue(f"variance of {name}", variance, 0.0, (DOUBT * bound) ** 2)
    std = np.sqrt(variances)
    room = np.outer(std, std) * (1 + CORRELATION_ROUNDING)
    for row, column in np.argwhere(np.abs(covariance) > room):
        if row != column:
            limit = float(room[row, column])
            what = f"covariance of {named[row][0]} with {named[column][0]}"
            yield BoundedValue(what, float(covariance[row, column]), -limit, limit)
