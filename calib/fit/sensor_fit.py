"""The sensor fit: torque gains and offsets, position gains, mass moments and load point from sweeps, in one problem.

Before it: is the reference mass there that the data set says? Judged before any gain is known, joint by joint.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import stdtrit
from threadpoolctl import threadpool_limits

from armlink.arm_file import ArmFile
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.dataset import SweepData, digests
from calib.fit.calibration import FitFinding, FittedCalibration, interval_text, rms
from calib.fit.examination import Goodness, examine
from calib.fit.sweep_readings import SweepReadings, sweep_readings
from calib.records.records import PARAMETERS, Discrepancy, Parameter
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.global_fit import GlobalFit, identify_global
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

LEAST, MOST = 0.4, 2.5
"""A mass that is felt as this share of the stated one is another mass: no sensor gain is so far from 1."""
MOST_SHARE_STD = 0.15
"""A joint counts if it tells the share to this standard deviation."""


def mass_complaint(arm: Arm, readings: StaticReadings) -> str | None:
    """Why the reference mass cannot be the stated one, whatever the gains are; None where it may be."""
    stated, felt = float(readings.load.max(initial=0.0)), felt_mass(arm, readings)
    if felt is None or LEAST <= felt / stated <= MOST:
        return None
    return (
        f"the loaded pass shows {felt:.1f} kg, but --reference-mass was {stated:g} kg: attach the mass, or give its "
        "right number, and sweep again."
    )


def felt_mass(arm: Arm, readings: StaticReadings) -> float | None:
    """The mass that is felt in readings with and without load, if gains are 1 [kg]; None if no joint tells it.

    Each joint is fitted alone: v = k (Y β + μ Y (E0 + Eρ ρ)) + o is linear in kβ, o, kμ and kμρ (docs/theory.md,
    section 4), and |kμ| over the stated mass is |k|, near 1, if the mass is there. Positions are taken as read.
    """
    stated = float(readings.load.max(initial=0.0))
    if stated <= 0 or (readings.load == stated).all():
        return None
    regressor = gravity_regressor(arm, readings.position)
    at_origin, by_point = payload_columns(arm)
    shares, spreads = [], []
    for joint in range(arm.n):
        counts = readings.counted[:, joint]
        rows, load = regressor[counts, joint, 2 * joint :], readings.load[counts, None] / stated
        loaded = np.hstack([load * (rows @ at_origin[2 * joint :, None]), load * (rows @ by_point[2 * joint :])])
        columns = np.hstack([loaded * stated, rows, np.ones((len(rows), 1))])
        found = _first(columns, readings.torque[counts, joint], readings.sigma[counts, joint])
        if found is not None and found[1] < MOST_SHARE_STD:
            shares.append(abs(found[0]))
            spreads.append(found[1])
    if not shares:
        return None
    return stated * float(np.average(shares, weights=1 / np.square(spreads)))


def _first(columns: Array, values: Array, sigma: Array) -> tuple[float, float] | None:
    """The first coefficient of a weighted fit and its standard deviation; None if the fit does not determine it."""
    if len(values) <= columns.shape[1]:
        return None
    weighted = columns / sigma[:, None]
    _, singular, basis = np.linalg.svd(weighted, full_matrices=False)
    kept = singular > 1e-9 * singular[0]
    if np.linalg.norm(basis[~kept, 0]) > 1e-6:
        return None
    inverse = (basis[kept].T / singular[kept] ** 2) @ basis[kept]
    solution = inverse @ (weighted.T @ (values / sigma))
    scatter = np.sum(np.square(values / sigma - weighted @ solution)) / (len(values) - kept.sum())
    return float(solution[0]), float(np.sqrt(inverse[0, 0] * max(scatter, 1.0)))


WIDE = 0.005
"""Half width of a gain's 95 % interval, as a share of it, from which it is listed as imprecise: the error that
tests/campaigns/random_arms.py allows a gain."""
COMMON = (
    "all gains share this error: their common scale comes from the reference mass and the distances between the joint "
    "axes, which are too short; measure where the reference mass hangs (sweep.reference_point), or use a heavier one"
)
"""Reason for a low precision of all gains together."""


@dataclass(frozen=True, eq=False)
class SensorFit(FittedCalibration):
    """Every sensor's gains and offsets from sweeps at rest."""

    arm: Arm
    rows: SweepReadings
    goodness: Goodness
    """Whether the sensor model holds, with findings."""
    gain_ratio: Array | None
    """Without a reference mass: gains as multiples of the last joint's (n,); NaN if unknown."""
    sources: dict[str, str]

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.arm.names

    @property
    def fit(self) -> GlobalFit:
        return self.goodness.refined.fit

    @property
    def noise_factor(self) -> Array:
        """Scatter of the readings over their samples' noise (n,)."""
        return self.goodness.refined.factor

    @cached_property
    def quantiles(self) -> Parameters:
        """Student quantiles of 95 % intervals, one a parameter."""
        return Parameters.from_vector(stdtrit(self.goodness.refined.certainty.vector, 0.975), self.arm.n)

    @cached_property
    def reasons(self) -> dict[tuple[str, Parameter], str]:  # type: ignore[override]
        return missing_values(self.fit, self.rows)

    @cached_property
    def hysteresis(self) -> Array:
        """Half the mean difference between readings approached upwards and downwards (n,) [N·m]."""
        left = self.rows.readings.torque - predict(self.arm, self.fit.complete, self.rows.readings)
        return _half_difference(left, self.rows)

    @cached_property
    def friction(self) -> Array:
        """Friction still locked at rest: half the mean difference of the drives' own torque between the directions,
        less that of the sensors (n,) [N·m]; NaN if the drives report none."""
        complete = self.fit.complete
        gain = np.where(np.abs(complete.gain) > 1e-6, complete.gain, 1.0)
        sensed = TorqueCalibration(gain, complete.offset).invert(self.rows.readings.torque)
        return _half_difference(self.rows.motor_torque - sensed, self.rows)

    def estimate(self, parameter: str) -> tuple[Array, Array]:
        return getattr(self.fit.values, parameter), getattr(self.fit.std, parameter)

    def covariance_of(self, wanted: Sequence[tuple[int, Parameter]]) -> Array:
        return self.fit.covariance_of(*(f"{parameter}[{self.names[joint]}]" for joint, parameter in wanted))

    def quantile(self, parameter: str) -> Array:
        return np.asarray(getattr(self.quantiles, parameter))

    @property
    def findings(self) -> tuple[FitFinding, ...]:  # type: ignore[override]
        return self.goodness.findings

    def discrepancy_of(self, joint: int) -> Discrepancy:
        return self.goodness.discrepancy[joint]

    @property
    def attachment(self) -> tuple[Array, Array] | None:
        """Place of the reference mass and half of its 95 % interval, (3,) each [m]; NaN if not determined.

        In the frame that turns with the last joint, origin on its axis. None without a reference mass.
        """
        if not any(self.rows.masses):
            return None
        point = self.fit.values.rho
        return point, np.where(np.isnan(point), np.nan, self.quantiles.rho * self.fit.std.rho)

    @property
    def attachment_text(self) -> str:
        """The attachment and mass moment of each reference mass in one sentence; empty without one."""
        if self.attachment is None:
            return ""
        point, half = self.attachment
        if np.isnan(point).all():
            return "the place of the reference mass is not observable"
        place = ", ".join(map(interval_text, point, half))
        moments = [
            f"({', '.join(interval_text(each, 0.0) for each in mass * point)}) kg·m with {mass:g} kg"
            for mass in self.rows.masses
            if mass
        ]
        return (
            f"the reference mass hung at ({place}) m in the frame of the last joint; its mass moment was "
            f"{'; '.join(moments)}"
        )

    @property
    def imprecise(self) -> dict[str, str]:
        """Joint → why its gain, though determined, is less precise than `WIDE`."""
        half = self.half95("gain") / np.abs(self.value("gain"))
        common = bool(np.all(half[np.isfinite(half)] > WIDE))
        why = (
            COMMON
            if common
            else "use more poses in its sweeps, or a reference mass that is heavier or hangs farther from its axis"
        )
        return {
            name: f"{name} gain: it is known only to ± {width:.1%}: {why}"
            for name, width in zip(self.names, half, strict=True)
            if width > WIDE
        }

    @property
    def residual_rms(self) -> Array:
        return rms(self.fit.residual)


def fit_sensors(arm_file: ArmFile, data: Sequence[SweepData]) -> SensorFit:
    """Fit every sensor of the arm to its sweep data sets (unloaded, with a reference mass, or several of each).

    Unknown are torque gains k and offsets o, position gains c, position offsets with the prior of the arm file
    (`sweep.position_offset_std`), mass moments β and the load point ρ; docs/theory.md, section 7. Raises BadInput on
    data that cannot be fitted, Refused on data of another arm.
    """
    rows = sweep_readings([each.require(arm_file) for each in data])
    loaded = any(rows.masses)
    with threadpool_limits(1, "blas"):  # matrices of a few hundred rows: on a busy machine threads are ten times slower
        good = _fit(arm_file, rows)
        gain_ratio = None if loaded else _gain_ratio(arm_file, rows)
    return SensorFit(gcomp_arm(arm_file), rows, good, gain_ratio, digests(data))


def _fit(arm_file: ArmFile, rows: SweepReadings, **extra: Prior) -> Goodness:
    kinematics, section = gcomp_arm(arm_file), sweep_section(arm_file)
    unknown = {"gain", "offset", "position_gain", "beta"}
    priors = dict(extra)
    if section.position_offset_std > 0:
        unknown.add("position_offset")
        priors["position_offset"] = Prior(0.0, section.position_offset_std)
    if any(rows.masses):
        unknown.add("rho")
        if section.known_point is not None:
            priors["rho"] = section.known_point
    fit = identify_global(kinematics, rows.readings, unknown=unknown, priors=priors, position_sigma=rows.position_sigma)
    return examine(kinematics, rows, fit, priors, arm_file.require_link().rated_torques)


def _half_difference(values: Array, rows: SweepReadings) -> Array:
    """Half the mean difference (n,) between upward and downward approach of each swept joint's own values (K, n)."""
    own, side = np.where(rows.own, values, np.nan), rows.readings.direction
    return np.array([_mean(own[side[:, j] > 0, j]) - _mean(own[side[:, j] < 0, j]) for j in range(own.shape[1])]) / 2


def _mean(values: Array) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")


def _gain_ratio(arm_file: ArmFile, rows: SweepReadings) -> Array:
    """Gains as multiples of the last joint's (n,), from data without a reference mass."""
    n = len(arm_file.joint_names)
    std = np.full(n, np.inf)
    std[-1] = 1e-4
    fit = _fit(arm_file, rows, gain=Prior(1.0, std)).refined.fit
    ratio: Array = fit.values.gain
    return np.where(fit.std.gain < 0.2, ratio, np.nan)


WHERE_IT_HANGS = ": measure where the reference mass hangs (sweep.reference_point in the arm file)"
"""Remedy for a gain that the readings with a mass leave open, as those of a single joint do."""


def missing_values(fit: GlobalFit, rows: SweepReadings) -> dict[tuple[str, Parameter], str]:
    """(joint, parameter) → reason, for each parameter without a value."""
    reasons: dict[tuple[str, Parameter], str] = {}
    lost = {name: found for name, found in zip(fit.names, fit.identifiable, strict=True) if not found}
    for name in (*lost, *fit.hopeless):
        family, _, joint = name.rstrip("]").partition("[")
        for parameter in PARAMETERS:
            if parameter == family:
                reasons[joint, parameter] = _reason(name, fit, rows)
    return reasons


def _reason(name: str, fit: GlobalFit, rows: SweepReadings) -> str:
    if name in fit.hopeless:
        spread = float(np.sqrt(fit.covariance_of(name)[0, 0]))
        return f"these sweeps determine it only to ± {2 * spread:.2g}, since gravity hardly loads the joint in them"
    for sentence in fit.null_space:
        if name in sentence:
            own = name.partition("[")[2]
            if sentence.startswith((f"{name} changes no reading", f"gain[{own}, position_gain[{own} can change")):
                return "gravity does not act on this joint in these poses, as with a vertical axis"
            if "common factor" in sentence and not any(rows.masses):
                return "no readings with a reference mass: only ratios of gains are determined"
            remedy = WHERE_IT_HANGS if "load_point" in sentence and name.startswith("gain") else ""
            if sentence.count(",") > 6:  # too many parameters to name
                return f"other values fit the data equally well{remedy or ': sweep more joints, in more poses'}"
            return f"{sentence}{remedy}"
    return "the readings do not determine it"
