"""The sensor fit: torque gains and offsets, position gains, mass moments and load point from sweeps, in one problem."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit
from threadpoolctl import threadpool_limits

from armlink.arm_file import ArmFile
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.dataset import SweepData, digests
from calib.fit.calibration import FittedCalibration
from calib.fit.examination import Goodness, examine
from calib.fit.findings import FitFinding
from calib.fit.sweep_readings import SweepReadings, sweep_readings
from calib.records.records import PARAMETERS, Discrepancy, Parameter
from gcomp.arrays import Array
from gcomp.identify.global_fit import GlobalFit, identify_global
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.sensor_model import predict

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

    names: tuple[str, ...]
    fit: GlobalFit
    rows: SweepReadings
    noise_factor: Array
    """Scatter of the readings over their samples' noise (n,)."""
    hysteresis: Array
    """Half the mean difference between readings approached upwards and downwards (n,) [N·m]."""
    friction: Array
    """Friction still locked at rest: half the mean difference of the drives' own torque between the directions, less
    that of the sensors (n,) [N·m]; NaN if the drives report none."""
    goodness: Goodness
    """Whether the sensor model holds, with findings."""
    quantiles: Parameters
    """Student quantiles of 95 % intervals, one a parameter."""
    reasons: dict[tuple[str, Parameter], str]
    gain_ratio: Array | None
    """Without a reference mass: gains as multiples of the last joint's (n,); NaN if unknown."""
    sources: dict[str, str]

    def estimate(self, parameter: str) -> tuple[Array, Array]:
        return getattr(self.fit.values, parameter), getattr(self.fit.std, parameter)

    def covariance_of(self, wanted: Sequence[tuple[int, Parameter]]) -> Array:
        return self.fit.covariance_of(*(f"{parameter}[{self.names[joint]}]" for joint, parameter in wanted))

    def quantile(self, parameter: str) -> Array:
        return np.asarray(getattr(self.quantiles, parameter))

    @property
    def findings(self) -> tuple[FitFinding, ...]:
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
            return "where the reference mass hung is not observable"
        place = ", ".join(_value_text(at, f" ± {by:.4f}") for at, by in zip(point, half, strict=True))
        moments = [f"{mass:g} kg: {_triple(mass * point)} kg·m" for mass in self.rows.masses if mass]
        return (
            f"the reference mass hung at ({place}) m in the frame of the last joint; its mass moment is "
            f"{'; '.join(moments)}"
        )

    @property
    def imprecise(self) -> dict[str, str]:
        """Joint → why its gain, though determined, is less precise than `WIDE`."""
        half = self.half95("gain") / np.abs(self.value("gain"))
        common = bool(np.all(half[np.isfinite(half)] > WIDE))
        why = COMMON if common else "use more poses in its sweeps, or a heavier reference mass"
        return {
            name: f"{name} gain: it is known only to ± {width:.1%}: {why}"
            for name, width in zip(self.names, half, strict=True)
            if width > WIDE
        }

    @property
    def residual_rms(self) -> Array:
        rms: Array = np.sqrt(np.nanmean(self.fit.residual**2, axis=0))
        return rms


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
    fit = good.refined.fit
    left = rows.readings.torque - predict(gcomp_arm(arm_file), fit.complete, rows.readings)
    return SensorFit(
        names=arm_file.joint_names,
        fit=fit,
        rows=rows,
        noise_factor=good.refined.factor,
        hysteresis=_half_difference(left, rows),
        friction=_friction(fit, rows),
        goodness=good,
        quantiles=Parameters.from_vector(stdtrit(good.refined.certainty.vector, 0.975), len(arm_file.joint_names)),
        reasons=missing_values(fit, rows),
        gain_ratio=gain_ratio,
        sources=digests(data),
    )


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


def _friction(fit: GlobalFit, rows: SweepReadings) -> Array:
    """Half difference (n,) between the directions of motor torque less sensor torque [N·m]."""
    gain = np.where(np.abs(fit.complete.gain) > 1e-6, fit.complete.gain, 1.0)
    sensed = TorqueCalibration(gain, fit.complete.offset).invert(rows.readings.torque)
    return _half_difference(rows.motor_torque - sensed, rows)


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


def _triple(values: Array) -> str:
    return f"({', '.join(map(_value_text, values))})"


def _value_text(value: float, interval: str = "") -> str:
    return "not observable" if np.isnan(value) else f"{value:.4f}{interval}"


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
        return f"these sweeps determine it only to ± {2 * spread:.2g}, since gravity hardly loads it in these poses"
    for sentence in fit.null_space:
        if name in sentence:
            if "common factor" in sentence and not any(rows.masses):
                return "no readings with a reference mass: only ratios of gains are determined"
            remedy = WHERE_IT_HANGS if "load_point" in sentence and name.startswith("gain") else ""
            if sentence.count(",") > 6:  # too many parameters to name
                return f"other values fit the data equally well{remedy or ': sweep more joints, in more poses'}"
            return f"{sentence}{remedy}"
    return "the readings do not determine it"
