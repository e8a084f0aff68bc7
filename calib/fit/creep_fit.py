"""Torque constants, friction, zeros and gravity from creep sweeps without and with a reference mass."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias, get_args

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from armlink.torque_calibration import GAIN_RANGE
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.dataset import SweepData, digests
from calib.fit.calibration import LOOSEST_GAIN, NOISE_ROUNDS, FitFinding, FittedCalibration
from calib.fit.creep_residuals import (
    SPRING_SHARE,
    Scatter,
    contact_finding,
    disturbed_sweep,
    ripple_cycles,
    scatter,
    springs,
)
from calib.fit.gravity_fit import GravityFit
from calib.fit.sweep_readings import SweepReadings, sweep_readings
from calib.plan.rough_gravity import NO_LEVER, SHORTEST, VERTICAL, is_vertical, known_lever
from calib.records.records import MotorTorque, Parameter
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.estimate.posterior import PosteriorFit, most_probable
from gcomp.identify.motor_model import HARMONICS, LAST_ZERO, MotorDoubt, MotorModel, family_slices

SEEN = 0.3
"""A parameter is found if the data leave so much of what was doubted beforehand, as a share of it."""
LEAST_COULOMB = 1e-3
"""Least friction that scales its unevenness, as a share of rated torque."""
ASSUMED = 4.0
"""Harmonics for which the doubt of the friction's unevenness counts, beside those that were measured."""
MOST_ZERO_DOUBT = 0.9
"""A zero counts as found if the data leave at most so much of its doubt, as a share."""
Value: TypeAlias = Literal["gain", "offset", "position_offset", "coulomb", "load", "viscous", "asymmetry", "warming"]
VALUES: tuple[Value, ...] = get_args(Value)


def family_of(parameter: str) -> str:
    """Family of the motor model that a value is of."""
    return "zero" if parameter == "position_offset" else parameter


@dataclass(frozen=True, eq=False)
class CreepFit(FittedCalibration):
    """The drives' values by creep sweeps. The gain is the drive's torque per true torque, g = 1/k."""

    arm: Arm
    rows: SweepReadings
    solution: PosteriorFit
    prior_std: Array
    ripple: Array
    """Periods in a turn of the ripple that each joint has, 0 for none (n,)."""
    findings: tuple[FitFinding, ...] = ()
    """Sweeps that were left out, and springs; the other values hold beside these."""
    sources: dict[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.arm.names

    @cached_property
    def slices(self) -> dict[str, slice]:
        return family_slices(self.arm.n)

    def estimate(self, parameter: str) -> tuple[Array, Array]:
        """Also of a family of the motor model."""
        if parameter == "position_gain":
            return np.ones(self.arm.n), np.zeros(self.arm.n)
        place = self.slices.get(family_of(parameter))
        if place is None:
            raise BadInput(f"creep sweeps give no value {parameter!r}; expected one of {', '.join(VALUES)}")
        return self.solution.x[place], np.sqrt(np.diag(self.solution.covariance)[place])

    def covariance_of(self, wanted: Sequence[tuple[int, Parameter]]) -> Array:
        places = [self.slices[family_of(parameter)].start + joint for joint, parameter in wanted]
        return self.solution.covariance[np.ix_(places, places)]

    @cached_property
    def found_gain(self) -> Mask:
        """Gains that the data determine (n,); without a mass none, since nothing tells the scale."""
        value, std = self.estimate("gain")
        low, high = GAIN_RANGE
        sure = (std < SEEN * self.prior_std[self.slices["gain"]]) & (std < LOOSEST_GAIN * np.abs(value))
        return np.asarray(sure & (low <= value) & (value <= high) & (self.rows.readings.load > 0).any())

    @cached_property
    def found_beta(self) -> Mask:
        """Mass moments that the data determine (2n,); without a gain none."""
        return (self.estimate("beta")[1] < SEEN * self.prior_std[self.slices["beta"]]) & self.found_gain.any()

    @property
    def beta(self) -> Array:
        """Mass moments (2n,) [kg·m]; 0 for those not found."""
        return np.where(self.found_beta, self.estimate("beta")[0], 0.0)

    @cached_property
    def residual_rms(self) -> Array:
        """With the ripple, which records do not hold."""
        own = [self.solution.residual[self.rows.swept == joint] for joint in range(self.arm.n)]
        sizes = np.linalg.norm(self.estimate("ripple")[0].reshape(-1, 2), axis=1) / np.sqrt(2)
        ripple = np.where(self.ripple > 0, self.estimate("gain")[0] * sizes, 0.0)
        return np.hypot(ripple, [np.sqrt(np.mean(each**2)) if each.size else np.nan for each in own])

    @cached_property
    def reasons(self) -> dict[tuple[str, Parameter], str]:  # type: ignore[override]
        reasons: dict[tuple[str, Parameter], str] = {}
        doubt = {family: self.prior_std[self.slices[family]] for family in ("offset", "zero")}
        offset, zero = (self.estimate(family)[1] / doubt[family] for family in ("offset", "zero"))
        for joint, name in enumerate(self.names):
            pull = next((each for each in self.findings if each.joint == name and each.kind == "spring"), None)
            if pull is not None:
                reasons[name, "gain"] = pull.text.removeprefix(f"{name}: ")
            elif not self.found_gain[joint]:
                reasons[name, "gain"] = self._no_gain(joint)
            if offset[joint] >= SEEN:
                reasons[name, "offset"] = "no sweep of this joint determines it"
            if joint == self.arm.n - 1 and doubt["zero"][joint] <= LAST_ZERO:
                reasons[name, "position_offset"] = (
                    "an error of this zero looks the same as a turned centre of mass of the last link"
                )
            elif zero[joint] >= MOST_ZERO_DOUBT:
                reasons[name, "position_offset"] = "the sweeps give no information about this value"
        return reasons

    def _no_gain(self, joint: int) -> str:
        if is_vertical(self.arm, joint):
            return VERTICAL
        if not (self.rows.swept == joint).any():
            return "every sweep of this joint was disturbed"
        if not (self.rows.readings.load > 0).any():
            return (
                "without a reference mass only the product of torque constant and mass is determined: sweep "
                "again with a reference mass"
            )
        if not self.found_gain.any() and known_lever(self.arm) < SHORTEST:
            return NO_LEVER
        return "gravity loads this joint too little in these sweeps: attach the mass further out, or add poses"

    def motor_of(self, joint: int) -> MotorTorque:
        def pair(family: str) -> tuple[float, float]:
            value, std = self.estimate(family)
            return float(value[joint]), float(std[joint])

        warmest = float(self.rows.warmest[joint])
        return MotorTorque(
            **{family: pair(family) for family in ("coulomb", "load", "viscous", "asymmetry")},
            temperature=warmest if np.isfinite(warmest) else None,
            gain_per_kelvin=pair("warming") if self.rows.by_temperature else None,
        )

    @property
    def gravity(self) -> GravityFit:
        """Mass moments of the arm without the reference mass, in true kg·m, and their covariance."""
        found, place = self.found_beta, self.slices["beta"]
        return GravityFit(
            names=self.names,
            beta=self.beta,
            covariance=self.solution.covariance[place, place] * np.outer(found, found),
            identifiable=found,
            recursive=None,
            residual_rms=self.residual_rms,
            sources=self.sources,
        )


def fit_creep(arm_file: ArmFile, data: Sequence[SweepData]) -> CreepFit:
    """Fit passes of creep sweeps, with and without a reference mass; raises BadInput where there is no such data."""
    rows = sweep_readings([each.require(arm_file) for each in data])
    if not rows.readings.velocity.any():
        raise BadInput(f"{data[0].path}: no creep sweeps: set `sweep.motion: creep` and sweep again")
    doubt = sweep_section(arm_file).motor_doubt
    fit = fit_rows(gcomp_arm(arm_file), rows, arm_file.require_link().rated_torques, doubt)
    contacts = tuple(contact_finding(each, stall) for each in data for stall in each.contacts)
    return replace(fit, findings=(*contacts, *fit.findings), sources=digests(data))


def fit_rows(arm: Arm, rows: SweepReadings, rated: Array, doubt: MotorDoubt | None = None) -> CreepFit:
    """Fit rows; rated torque (n,) [N·m] scales what is doubted beforehand. Disturbed sweeps are left out by name."""
    doubt = doubt or MotorDoubt()
    left_out: tuple[FitFinding, ...] = ()
    plain = _fit(arm, rows, rated, doubt, ripple=False)  # which a contact would be taken for
    while found := disturbed_sweep(arm.names, plain.rows, plain.solution.residual, rated):
        left_out = (*left_out, found[1])
        rows = rows.kept(rows.readings.series != found[0])
        plain = _fit(arm, rows, rated, doubt, ripple=False)
    plain = _fit(arm, rows, rated, doubt, plain.solution.x)
    loose = replace(doubt, spring_share=SPRING_SHARE)
    free = _fit(arm, rows, rated, loose, plain.solution.x, ripple=False)
    pulled = springs(arm.names, rows, *free.estimate("spring"), rated)
    fit = _fit(arm, rows, rated, loose, free.solution.x) if pulled else plain
    return replace(fit, findings=(*left_out, *pulled))


def _fit(
    arm: Arm, rows: SweepReadings, rated: Array, doubt: MotorDoubt, start: Array | None = None, ripple: bool = True
) -> CreepFit:
    model, slices = MotorModel(arm, rows.readings), family_slices(arm.n)
    scattered = Scatter.even(rows, 0.01 * rated[rows.swept])
    mean, std = doubt.prior(arm, rated, rows.by_temperature, 0.02 * rated)
    x = mean.copy() if start is None else start
    for _ in range(NOISE_ROUNDS):
        found = most_probable(model, scattered.whitened, mean, std, x)
        x = found.x
        coulomb = np.maximum(np.abs(x[slices["coulomb"]]), LEAST_COULOMB * rated)
        uneven = _unevenness(found, std, coulomb, doubt)
        mean, std = doubt.prior(arm, rated, rows.by_temperature, coulomb, uneven)
        determined = float(np.sum(1 - np.diag(found.covariance) / std**2))  # by the data, and not the prior
        freedom = 1 - determined / len(rows)
        by_degree = _temperature_std(rows) * x[slices["warming"]][rows.swept] * rows.reading
        scattered = scatter(rows, found.residual, rated, freedom, by_degree, ripple)
        if ripple and not model.ripple.any():
            model = MotorModel(arm, rows.readings, ripple_cycles(rows, found.residual))
    return CreepFit(arm, rows, found, std, model.ripple)


def _unevenness(found: PosteriorFit, std: Array, coulomb: Array, doubt: MotorDoubt) -> Array:
    """Usual size of each harmonic of the friction over position (HARMONICS,), as a share of the Coulomb friction.

    That of all joints' harmonics of one order, which count by what the data tell of them, and of `ASSUMED` more of the
    size that is doubted beforehand.
    """
    place = family_slices(len(coulomb))["uneven"]
    shares = found.x[place].reshape(-1, HARMONICS, 2) / coulomb[:, None, None]
    told = (1 - np.diag(found.covariance)[place] / std[place] ** 2).clip(0.0).reshape(shares.shape)
    size = (ASSUMED * doubt.uneven**2 + (shares**2).sum(axis=(0, 2))) / (ASSUMED + told.sum(axis=(0, 2)))
    return np.asarray(np.sqrt(size))


def _temperature_std(rows: SweepReadings) -> float:
    """Standard deviation that the rounding of the temperatures leaves [K]; 0 where none are told."""
    own = rows.swept_value(rows.readings.warmth)
    steps = np.diff(np.unique(own.round(6))) if rows.by_temperature else np.empty(0)
    return float(steps.min(initial=1.0)) / np.sqrt(12) if steps.size else 0.0
