"""Torque sensor calibration: reading = gain · torque + offset, of one joint or of all joints of an arm."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar, overload

import numpy as np

from armlink.arrays import Array
from armlink.errors import BadInput

V = TypeVar("V", float, Array)
GAIN_RANGE = (0.5, 2.0)
"""Gains beyond these are no gains of a sensor; none is ever put into force."""
MOST_OFFSET = 1e4
"""Offsets beyond this are none of a sensor [N·m]; likewise."""
REAL32_STEP = 1e-6
"""Relative difference that REAL32 in a controller may make to a value, the rounding of decimal output included."""


@dataclass(frozen=True, eq=False)
class TorqueCalibration(Generic[V]):
    """Gain and offset of one torque sensor (floats) or of n sensors ((n,) arrays, applied along the last axis).

    With v the reading of the sensor and τ the torque [N·m]: v = gain · τ + offset (docs/theory.md, section 1.4). A
    joint controller that holds it sends τ = (v − offset) / gain. NaN marks an unknown value and passes through.
    """

    gain: V
    offset: V
    """[N·m]"""

    @overload
    def apply(self: "TorqueCalibration[float]", torque: float) -> float: ...
    @overload
    def apply(self, torque: Array) -> Array: ...
    def apply(self, torque: float | Array) -> float | Array:
        """Sensor reading v at a torque [N·m]."""
        return self.gain * torque + self.offset

    @overload
    def invert(self: "TorqueCalibration[float]", reading: float) -> float: ...
    @overload
    def invert(self, reading: Array) -> Array: ...
    def invert(self, reading: float | Array) -> float | Array:
        """Torque τ [N·m] from a sensor reading."""
        return (reading - self.offset) / self.gain

    def compose(self, change: "TorqueCalibration[V]") -> "TorqueCalibration[V]":
        """The calibration v = self(change(τ)) of a sensor that was calibrated by `self` and has changed by `change`.

        A controller with the calibration `self` sends change(τ) instead of τ; with the result it sends τ again.
        """
        return TorqueCalibration(self.gain * change.gain, self.offset + self.gain * change.offset)

    def relative_to(self, held: "TorqueCalibration[V]") -> "TorqueCalibration[V]":
        """The change c(τ) that a controller with the calibration `held` sends for this sensor; inverse of `compose`."""
        return TorqueCalibration(self.gain / held.gain, (self.offset - held.offset) / held.gain)

    def matches(self: "TorqueCalibration[float]", held: "TorqueCalibration[float]") -> bool:
        """Whether `held`, read from a controller, equals this in REAL32; False with NaN."""
        return same_real32(self.gain, held.gain) and same_real32(self.offset, held.offset)


@dataclass(frozen=True)
class Calibration(TorqueCalibration[float]):
    """Torque calibration of one joint that is in force, in its controller or in the host, and of which record it is."""

    record_id: int = 0
    date: int = 0
    """Date of the record [s since 1970]; 0 if none was written."""
    crc: int = 0
    """CRC-32 as the controller reports it; ignored in a calibration that is to be written."""

    @property
    def is_blank(self) -> bool:
        """Whether no calibration was ever written: gain 1, offset 0, record 0."""
        return (self.gain, self.offset, self.record_id) == (1.0, 0.0, 0)

    def require_usable(self, joint: str) -> None:
        """Raise BadInput for values that no sensor of this joint has."""
        if not (GAIN_RANGE[0] <= self.gain <= GAIN_RANGE[1] and abs(self.offset) < MOST_OFFSET):
            raise BadInput(
                f"{joint}: gain {self.gain} and offset {self.offset} N·m: the gain must be {GAIN_RANGE[0]} to "
                f"{GAIN_RANGE[1]}, and the offset a finite number"
            )


def per_joint(calibrations: Iterable[TorqueCalibration[float]]) -> TorqueCalibration[Array]:
    pairs = [(each.gain, each.offset) for each in calibrations]
    gain, offset = np.array(pairs, dtype=np.float64).reshape(-1, 2).T.copy()
    return TorqueCalibration(gain, offset)


def same_real32(wanted: float, found: float) -> bool:
    """Whether a value read from a controller equals the one wanted in REAL32."""
    return abs(found - wanted) <= REAL32_STEP * max(1.0, abs(wanted))


UNCALIBRATED = TorqueCalibration(1.0, 0.0)
"""The calibration of a new controller, which sends the sensor's own reading."""
UNKNOWN = TorqueCalibration(float("nan"), float("nan"))
"""Gain and offset not identifiable."""
