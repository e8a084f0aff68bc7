"""Results of creep sweeps: a calibration with friction, kept by the host, and gravity; records of both."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias, get_args

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from calib.creep.fit import QUANTILE, CreepFit
from calib.creep.levers import NO_LEVER, SHORTEST, VERTICAL, is_vertical, known_lever
from calib.creep.parameters import LAST_ZERO
from calib.fit.gravity_fit import GravityFit
from calib.records.records import CalibrationRecord, JointCalibration, MotorTorque, Parameter, matrix, provenance
from gcomp.arrays import Array

MOST_ZERO_DOUBT = 0.9
"""A zero counts as found if the data leave at most so much of its doubt, as a share."""
Value: TypeAlias = Literal["gain", "offset", "position_offset", "coulomb", "load", "viscous", "asymmetry", "warming"]
VALUES: tuple[Value, ...] = get_args(Value)
RECORDED: tuple[Literal["gain", "offset", "position_offset"], ...] = ("gain", "offset", "position_offset")
"""Parameters that a record has from creep sweeps; without a value they have a reason."""


def family_of(parameter: Value) -> str:
    """Family of the fit that a value is of; raises BadInput where there is none."""
    if parameter not in VALUES:
        raise BadInput(f"creep sweeps give no value {parameter!r}; there are {', '.join(VALUES)}")
    return "zero" if parameter == "position_offset" else parameter


@dataclass(frozen=True, eq=False)
class CreepCalibration:
    """The drives' values by creep sweeps: NaN where the sweeps do not determine one, with the cause in `reasons`."""

    fit: CreepFit

    @property
    def names(self) -> tuple[str, ...]:
        return self.fit.names

    @cached_property
    def reasons(self) -> dict[tuple[str, Parameter], str]:
        """(Joint, parameter) → why it has no value."""
        return _missing(self.fit)

    @property
    def findings(self) -> tuple[str, ...]:
        """Disturbances of the sweeps, one sentence each."""
        return self.fit.findings

    @property
    def sources(self) -> dict[str, str]:
        """Names and digests of the data sets."""
        return self.fit.sources

    @property
    def residual_rms(self) -> Array:
        """RMS of each joint's residual (n,) [N·m]."""
        return self.fit.residual_rms

    def value(self, parameter: Value) -> Array:
        """Estimates (n,); the gain is what a drive reads for 1 N·m, 1/k."""
        found = self.fit.value(family_of(parameter))
        return np.where([(name, parameter) in self.reasons for name in self.names], np.nan, found)

    def std(self, parameter: Value) -> Array:
        """Standard deviations (n,)."""
        return np.where(np.isnan(self.value(parameter)), np.nan, self.fit.std(family_of(parameter)))

    def half95(self, parameter: Value) -> Array:
        """Half widths (n,) of the 95 % intervals."""
        return QUANTILE * self.std(parameter)

    def ci95(self, parameter: Value) -> Array:
        """95 % intervals (n, 2)."""
        value, half = self.value(parameter), self.half95(parameter)
        return np.stack([value - half, value + half], axis=1)

    def record(self, arm_file: ArmFile) -> CalibrationRecord:
        """Gains 1/k, offsets, zeros and friction of all joints."""
        fit, reasons, rms = self.fit, self.reasons, self.residual_rms
        joints = []
        for joint, name in enumerate(fit.names):
            gain, offset, zero = (
                None if (name, p) in reasons else float(fit.value(family_of(p))[joint]) for p in RECORDED
            )
            joints.append(
                JointCalibration(
                    name=name,
                    gain=gain,
                    offset=offset,
                    position_gain=1.0,
                    position_offset=zero,
                    not_identifiable={p: reasons[name, p] for p in RECORDED if (name, p) in reasons},
                    residual_std=float(rms[joint]) if np.isfinite(rms[joint]) else None,
                    motor=_motor(fit, joint),
                )
            )
        kept = [(name, p) for name in fit.names for p in RECORDED if (name, p) not in reasons]
        places = [fit.slices[family_of(p)].start + fit.names.index(name) for name, p in kept]
        return CalibrationRecord(
            **provenance(arm_file, fit.sources),
            joints=tuple(joints),
            covariance_of=tuple(f"{name}.{p}" for name, p in kept),
            covariance=matrix(fit.covariance[np.ix_(places, places)]),
        )

    @property
    def gravity(self) -> GravityFit:
        """Mass moments of the arm without the reference mass, in true kg·m, and their covariance."""
        fit, found, place = self.fit, self.fit.found("beta"), self.fit.slices["beta"]
        return GravityFit(
            names=fit.names,
            beta=fit.beta,
            covariance=fit.covariance[place, place] * np.outer(found, found),
            identifiable=found,
            recursive=None,
            residual_rms=fit.residual_rms,
            sources=fit.sources,
        )


def _missing(fit: CreepFit) -> dict[tuple[str, Parameter], str]:
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
            reasons[name, "offset"] = "no sweep of this joint determines it"
        if joint == fit.arm.n - 1 and fit.prior_std[fit.slices["zero"]][joint] <= LAST_ZERO:
            reasons[name, "position_offset"] = "turning the last link's frame is the same as turning its centre of mass"
        elif not zero[joint]:
            reasons[name, "position_offset"] = "the sweeps add nothing to what was known before about this value"
    return reasons


def _no_gain(fit: CreepFit, joint: int, loaded: bool) -> str:
    if not (fit.rows.joint == joint).any():
        return "every sweep of this joint was disturbed"
    if not loaded:
        return (
            "without a reference mass only the product of torque constant and mass is determined: sweep again "
            "with a reference mass"
        )
    if not fit.found("gain").any() and known_lever(fit.arm) < SHORTEST:
        return NO_LEVER
    return "gravity loads this joint too little in these sweeps: attach the mass further out, or add poses"


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
