"""A calibration: values of all joints with intervals, why some are missing, findings, and the record."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from armlink.arm_file import ArmFile
from calib.records.records import (
    PARAMETERS,
    CalibrationRecord,
    Discrepancy,
    JointCalibration,
    MotorTorque,
    Parameter,
    matrix,
    provenance,
)
from gcomp.arrays import Array

QUANTILE = 1.96
"""Of a normal distribution, of 95 % intervals."""
VERY_STRONG_EVIDENCE = 10.0
"""BIC difference that counts as decided: odds of 150 to 1 (docs/theory.md, 4.3 and 6.4)."""
SIGNIFICANCE = 5.0
"""A change or an effect counts only if it is this many standard deviations (docs/theory.md, 6.6)."""
NOISE_ROUNDS = 4
"""Fits, each with the noise that the residuals of the one before show."""
USUAL_ROWS = 5
"""Rows that the usual scatter, or what is assumed at first, counts for beside those that are measured."""
LOOSEST_GAIN = 0.02
"""Standard deviation of a gain, as a share of it, above which it is of no use."""
NOMINAL: dict[Parameter, float] = {"position_gain": 1.0, "position_offset": 0.0}
"""Values of position sensors that were not fitted."""


def interval_text(value: float, half: float) -> str:
    """A value ± half of its 95 % interval; alone where that is 0."""
    if not np.isfinite(value):
        return "not observable"
    if not 0 < half < np.inf:
        return f"{value:.4f}"
    places = max(4, -int(np.floor(np.log10(half))))  # an interval is never "± 0.0000"
    return f"{value:.{places}f}\u00a0±\u00a0{half:.{places}f}"


def rms(values: Array) -> Array:
    """RMS of each joint's values (K, n) that are numbers (n,)."""
    count = np.isfinite(values).sum(axis=0)
    return np.asarray(np.sqrt(np.nansum(values**2, axis=0) / np.where(count, count, np.nan)))


def common_scale_std(covariance: Array, gain: Array) -> float:
    """Standard deviation of a factor common to gains (G,), as a share, by their covariance (G, G)."""
    return float(np.sqrt(max(float((covariance / np.outer(gain, gain)).mean()), 0.0)))


Kind = Literal[
    "spring",
    "direction",
    "hysteresis",
    "nonlinear",
    "saturation",
    "drift",
    "eccentricity",
    "encoder",
    "outliers",
    "scatter",
    "contact",
]
OUTLIER = 6.0
"""Robust standard deviations of a joint's residuals from which a reading, or a sweep, is not one of the others
(docs/theory.md, 5.4)."""
HOLDING: tuple[Kind, ...] = ("direction", "hysteresis", "outliers", "contact")
"""Findings that the fit removes completely: with them removed the model holds."""


@dataclass(frozen=True, eq=False)
class FitFinding:
    """An effect in the readings that the sensor model does not have."""

    joint: str
    kind: Kind
    size: float
    """In `unit`; NaN if no single number describes it."""
    unit: str
    text: str
    """One sentence for the user."""


class FittedCalibration(ABC):
    """Result of a fit to readings of any kind; NaN where they do not determine a value, with the cause in `reasons`."""

    names: tuple[str, ...]
    reasons: dict[tuple[str, Parameter], str]
    """(Joint, parameter) → why it has no value."""
    sources: dict[str, str]
    """Names and digests of the data sets."""
    findings: tuple[FitFinding, ...] = ()
    """Effects in the readings that the model does not have."""

    @abstractmethod
    def estimate(self, parameter: str) -> tuple[Array, Array]:
        """(Values, standard deviations) of one parameter (n,), whether determined or not; 0 where it was known."""

    @abstractmethod
    def covariance_of(self, wanted: Sequence[tuple[int, Parameter]]) -> Array:
        """Covariance of parameters, each given by its joint."""

    @property
    @abstractmethod
    def residual_rms(self) -> Array:
        """RMS of each joint's torque residual over the readings that count (n,) [N·m]."""

    @property
    def broken(self) -> dict[str, str]:
        """Why the model does not hold at a joint, in a sentence: the first finding of each such joint."""
        found: dict[str, str] = {}
        for each in self.findings:
            if each.kind not in HOLDING:
                found.setdefault(each.joint, each.text)
        return found

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Joints at which the model does not hold, so that their values must not be used."""
        return tuple(name for name in self.names if name in self.broken)

    def quantile(self, parameter: str) -> Array | float:
        """Of 95 % intervals (n,), in standard deviations."""
        return QUANTILE

    def value(self, parameter: str) -> Array:
        """Estimates (n,)."""
        lost = [(name, parameter) in self.reasons for name in self.names]
        found = self.estimate(parameter)[0]
        return np.where(lost, np.nan, found) if any(lost) else found

    def std(self, parameter: str) -> Array:
        """Standard deviations (n,)."""
        value = self.value(parameter)
        return np.where(np.isnan(value), np.nan, self.estimate(parameter)[1])

    def half95(self, parameter: str) -> Array:
        """Half widths (n,) of the 95 % intervals."""
        return np.asarray(self.quantile(parameter) * self.std(parameter))

    def ci95(self, parameter: str) -> Array:
        """95 % intervals (n, 2)."""
        value, half = self.value(parameter), self.half95(parameter)
        return np.stack([value - half, value + half], axis=1)

    def discrepancy_of(self, joint: int) -> Discrepancy | None:
        """Remaining doubt at a new pose."""
        return None

    def motor_of(self, joint: int) -> MotorTorque | None:
        """Friction of a joint whose torque is a motor current."""
        return None

    def record(self, arm_file: ArmFile, before: CalibrationRecord | None = None) -> CalibrationRecord:
        """The values as a record; those that `before` has and this does not are carried over from it."""
        values = {parameter: self.value(parameter) for parameter in PARAMETERS}
        stds = {parameter: self.std(parameter) for parameter in PARAMETERS}
        own = [(j, p) for j in range(len(self.names)) for p in PARAMETERS if stds[p][j] > 0]
        names = tuple(f"{self.names[j]}.{p}" for j, p in own)
        covariance = self.covariance_of(own) if own else np.zeros((0, 0))
        if before is not None:
            carried = [name for name in before.covariance_of if name not in names]
            at = [before.covariance_of.index(name) for name in carried]
            whole = np.zeros((len(names) + len(carried),) * 2)
            whole[: len(names), : len(names)] = covariance
            whole[len(names) :, len(names) :] = np.array(before.covariance)[np.ix_(at, at)] if at else 0.0
            names, covariance = (*names, *carried), whole
        return CalibrationRecord(
            **provenance(arm_file, self.sources),
            joints=tuple(self._joint(j, values, before) for j in range(len(self.names))),
            covariance_of=names,
            covariance=matrix(covariance) if names else (),
        )

    def _joint(self, j: int, values: dict[Parameter, Array], before: CalibrationRecord | None) -> JointCalibration:
        name, old, rms = self.names[j], None if before is None else before.joints[j], float(self.residual_rms[j])
        found: dict[str, Any] = {}
        missing: dict[Parameter, str] = {}
        for parameter in PARAMETERS:
            value, reason = float(values[parameter][j]), self.reasons.get((name, parameter))
            found[parameter] = value if np.isfinite(value) else getattr(old, parameter, None)
            if found[parameter] is None and old is None and reason is None:
                found[parameter] = NOMINAL[parameter]
            elif found[parameter] is None:
                known = None if old is None else old.not_identifiable.get(parameter)
                missing[parameter] = known or reason or ""
        return JointCalibration(
            name=name,
            **found,
            not_identifiable=missing,
            residual_std=rms if np.isfinite(rms) else None,
            discrepancy=self.discrepancy_of(j) if old is None else old.discrepancy,
            motor=self.motor_of(j),
        )
