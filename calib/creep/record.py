"""Records of a creep fit: a calibration with friction, kept by the host, and gravity."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.creep.choice import NO_LEVER, SHORTEST, VERTICAL, is_vertical, known_lever
from calib.creep.fit import QUANTILE, CreepFit
from calib.creep.parameters import LAST_ZERO
from calib.fit.gravity_fit import GravityFit
from calib.records.records import (
    CalibrationRecord,
    GravityRecord,
    JointCalibration,
    MotorTorque,
    Parameter,
    matrix,
    provenance,
)
from gcomp.arrays import Array, Mask

MOST_ZERO_DOUBT = 0.9
"""A zero counts as found if the data leave at most so much of its doubt, as a share."""
Value: TypeAlias = Literal["gain", "offset", "position_offset", "coulomb", "load", "viscous"]
FAMILY: dict[Parameter, str] = {"gain": "gain", "offset": "offset", "position_offset": "zero"}
"""Parameter of a record → family of the fit."""
VALUES: dict[Value, str] = {
    "gain": FAMILY["gain"],
    "offset": FAMILY["offset"],
    "position_offset": FAMILY["position_offset"],
    "coulomb": "coulomb",
    "load": "load",
    "viscous": "viscous",
}
"""Value by the name that programs use → family of the fit."""
HEADINGS = {
    "gain": "reading per N·m (1/k)",
    "offset": "offset [N·m]",
    "zero": "zero [rad]",
    "coulomb": "Coulomb friction [N·m]",
    "load": "friction per load",
    "viscous": "viscous [N·m·s/rad]",
}
"""Families of the fit, as people read them."""


def missing(fit: CreepFit) -> dict[tuple[str, Parameter], str]:
    """(Joint, parameter) → why the data cannot determine it."""
    reasons: dict[tuple[str, Parameter], str] = {}
    found = {"gain": fit.found("gain"), "offset": fit.found("offset")}
    zero = fit.std("zero") < MOST_ZERO_DOUBT * fit.prior_std[fit.slices["zero"]]
    loaded = bool((fit.rows.mass > 0).any())
    for joint, name in enumerate(fit.names):
        upright = is_vertical(fit.arm, joint)
        pull = next((each for each in fit.springs if each.joint == name), None)
        if pull is not None:
            reasons[name, "gain"] = str(pull).removeprefix(f"{name}: ")
        elif not found["gain"][joint]:
            reasons[name, "gain"] = VERTICAL if upright else _no_gain(fit, joint, loaded)
        if not found["offset"][joint]:
            reasons[name, "offset"] = "no sweep of this joint shows it"
        if joint == fit.arm.n - 1 and fit.prior_std[fit.slices["zero"]][joint] <= LAST_ZERO:
            reasons[name, "position_offset"] = "turning the last link's frame is the same as turning its centre of mass"
        elif not zero[joint]:
            reasons[name, "position_offset"] = "the sweeps add nothing to what was known before"
    return reasons


def determined_joints(fit: CreepFit, family: str) -> Mask:
    """Joints for which the data determine a family's value (n,); of friction every joint."""
    reasons = missing(fit)
    parameter = next((each for each, of in FAMILY.items() if of == family), None)
    return np.array([parameter is None or (name, parameter) not in reasons for name in fit.names])


def determined_values(fit: CreepFit, family: str) -> Array:
    """A family's estimates (n,), NaN where the data do not determine them."""
    return np.where(determined_joints(fit, family), fit.value(family), np.nan)


def _no_gain(fit: CreepFit, joint: int, loaded: bool) -> str:
    if not (fit.rows.joint == joint).any():
        return "no sweep of this joint was free of disturbance"
    if not loaded:
        return "without a reference mass only the product of torque constant and mass shows: sweep again with one"
    if not fit.found("gain").any() and known_lever(fit.arm) < SHORTEST:
        return NO_LEVER
    return "gravity loads this joint too little in these sweeps: attach the mass further out, or add poses"


def calibration_record(fit: CreepFit, arm_file: ArmFile) -> CalibrationRecord:
    """Gains 1/k, offsets, zeros and friction of all joints; a value that the data do not determine has a reason."""
    reasons = missing(fit)
    joints = []
    for joint, name in enumerate(fit.names):
        own: dict[Parameter, str] = {parameter: reason for (of, parameter), reason in reasons.items() if of == name}
        gain, offset, zero = (
            None if parameter in own else float(fit.value(family)[joint]) for parameter, family in FAMILY.items()
        )
        joints.append(
            JointCalibration(
                name=name,
                gain=gain,
                offset=offset,
                position_gain=1.0,
                position_offset=zero,
                not_identifiable=own,
                residual_std=float(fit.residual_rms[joint]) if np.isfinite(fit.residual_rms[joint]) else None,
                motor=_motor(fit, joint),
            )
        )
    kept = [(name, p) for name in fit.names for p in FAMILY if (name, p) not in reasons]
    places = [fit.slices[FAMILY[p]].start + fit.names.index(name) for name, p in kept]
    return CalibrationRecord(
        **provenance(arm_file, fit.sources),
        joints=tuple(joints),
        covariance_of=tuple(f"{name}.{p}" for name, p in kept),
        covariance=matrix(fit.covariance[np.ix_(places, places)]),
    )


def _motor(fit: CreepFit, joint: int) -> MotorTorque:
    def pair(family: Literal["coulomb", "load", "viscous", "asymmetry", "warming"]) -> tuple[float, float]:
        return float(fit.value(family)[joint]), float(fit.std(family)[joint])

    rows = fit.rows
    return MotorTorque(
        coulomb=pair("coulomb"),
        load=pair("load"),
        viscous=pair("viscous"),
        asymmetry=pair("asymmetry"),
        temperature=float(rows.warmest[joint]) if np.isfinite(rows.warmest[joint]) else None,
        gain_per_kelvin=pair("warming") if rows.by_temperature else None,
    )


def gravity_fit(fit: CreepFit) -> GravityFit:
    """Mass moments of the arm without the reference mass, in true kg·m, and their covariance."""
    found, place = fit.found("beta"), fit.slices["beta"]
    return GravityFit(
        names=fit.names,
        beta=fit.beta,
        covariance=fit.covariance[place, place] * np.outer(found, found),
        identifiable=found,
        recursive=None,
        residual_rms=fit.residual_rms,
        sources=fit.sources,
    )


def gravity_record(fit: CreepFit, arm_file: ArmFile, calibration: CalibrationRecord | None) -> GravityRecord:
    return gravity_fit(fit).record(arm_file, calibration)


@dataclass(frozen=True, eq=False)
class CreepCalibration:
    """The drives' values by creep sweeps, as programs ask for them: NaN where the sweeps do not determine one."""

    fit: CreepFit

    @property
    def names(self) -> tuple[str, ...]:
        return self.fit.names

    @cached_property
    def reasons(self) -> dict[tuple[str, Parameter], str]:
        """(Joint, parameter) → why it has no value."""
        return missing(self.fit)

    @property
    def findings(self) -> tuple[str, ...]:
        """Disturbances of the sweeps, one sentence each."""
        return self.fit.findings

    @property
    def residual_rms(self) -> Array:
        """RMS of each joint's residual (n,) [N·m]."""
        return self.fit.residual_rms

    def value(self, parameter: Value) -> Array:
        """Estimates (n,); the gain is what a drive reads for 1 N·m, 1/k."""
        return determined_values(self.fit, self._family(parameter))

    def std(self, parameter: Value) -> Array:
        """Standard deviations (n,)."""
        return np.where(np.isnan(self.value(parameter)), np.nan, self.fit.std(self._family(parameter)))

    def ci95(self, parameter: Value) -> Array:
        """95 % intervals (n, 2)."""
        half = QUANTILE * self.std(parameter)
        return np.stack([self.value(parameter) - half, self.value(parameter) + half], axis=1)

    def record(self, arm_file: ArmFile) -> CalibrationRecord:
        return calibration_record(self.fit, arm_file)

    @staticmethod
    def _family(parameter: Value) -> str:
        if parameter not in VALUES:
            raise BadInput(f"no value {parameter!r} of creep sweeps; there are {', '.join(VALUES)}")
        return VALUES[parameter]
