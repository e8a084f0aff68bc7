"""The demo's result, and its form for machines (`summary.json`, schema armlink.demo/1)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from armlink.link.types import Stats
from calib.creep.fit import CreepFit
from calib.creep.record import CreepCalibration
from calib.fit.sensor_fit import SensorFit
from calib.sweep.verify import Verification
from sim_bus.truth import Truth
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.bench import Bench, GravityCheck, Sag
from sim_gap.demo.drift import DriftCourse


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Setting, hidden truth and measurements of a demo."""

    bench: Bench
    """With the truth as it was after the sweeps."""
    seed: int
    sensors: SensorFit | CreepCalibration
    """Calibration of torque sensors, or of drives without."""
    gravity_check: GravityCheck
    verify: Verification
    gap: Diagnosis
    bus: Stats
    wall_s: float
    sim_s: float
    drift: DriftCourse | None = None
    """Of a torque sensor; None without sensors."""
    sag: Sag | None = None
    """Of an arm without torque sensors whose file names a model."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.bench.link.names

    @property
    def truth(self) -> Truth:
        return self.bench.truth

    @property
    def creep(self) -> CreepFit | None:
        """The fit of creep sweeps; None of steps at rest."""
        return self.sensors.fit if isinstance(self.sensors, CreepCalibration) else None


def summary(result: DemoResult) -> dict[str, Any]:
    """`summary.json`; null where a value cannot be determined."""
    check, bus, fit, creep = result.gravity_check, result.bus, result.sensors, result.creep
    shown = ("gain", "offset", "position_gain" if creep is None else "position_offset")
    return {
        "schema": "armlink.demo/1",
        "arm": result.bench.arm.name,
        "seed": result.seed,
        "joints": list(result.names),
        "sensors": {
            name: {
                "true": numbers(getattr(result.truth, name)),
                "estimated": numbers(fit.value(name)),  # type: ignore[arg-type]
                "ci95": _intervals(fit.ci95(name)),  # type: ignore[arg-type]
            }
            for name in shown
        },
        **({} if creep is None else {"friction": _friction(result, creep)}),
        "not_identifiable": {f"{joint}.{parameter}": reason for (joint, parameter), reason in fit.reasons.items()},
        **({} if creep is None else {"disturbed": list(creep.findings), "sag": _sag(result.sag)}),
        "drift": _drift(result),
        "gravity": {
            "poses": check.poses,
            "max_torque": numbers(check.max_torque),
            "rms_error": numbers(check.rms_error),
            "max_abs_error": numbers(check.max_abs_error),
        },
        "verify": {"poses": len(result.verify.position), "rms": numbers(result.verify.rms)},
        "gap": result.gap.to_json(),
        "bus": {"frames": bus.frames, "rate_hz": number(bus.rate_hz), "load": number(bus.load), "missed": bus.missed},
        "wall_s": number(result.wall_s),
        "sim_s": number(result.sim_s),
    }


def _friction(result: DemoResult, fit: CreepFit) -> dict[str, Any]:
    found = {
        family: {"estimated": numbers(fit.value(family)), "ci95": _intervals(fit.ci95(family))}
        for family in ("coulomb", "load", "viscous", "asymmetry")
    }
    return found | {"coulomb": {"true": numbers(result.bench.simulated.true_friction), **found["coulomb"]}}


def _sag(sag: Sag | None) -> dict[str, Any] | None:
    if sag is None:
        return None
    return {"poses": sag.poses, "nominal": numbers(sag.nominal), "calibrated": numbers(sag.calibrated)}


def _drift(result: DemoResult) -> dict[str, Any] | None:
    if (drift := result.drift) is None:
        return None
    return {
        "joint": result.names[drift.joint],
        "gain": drift.gain,
        "offset": drift.offset,
        "detected_after_s": None if drift.detected is None else number(drift.detected - drift.began),
        "recalibrated": drift.recalibrated is not None,
        "recalibrated_after_s": None if drift.recalibrated is None else number(drift.recalibrated - drift.began),
        "gain_error_after": number(abs(drift.error_after[0])),
        "offset_error_after": number(abs(drift.error_after[1])),
    }


def _intervals(ends: Iterable[npt.ArrayLike]) -> list[list[float | None] | None]:
    """Ends (n, 2) of intervals; null for a joint without one."""
    return [None if row[0] is None else row for row in map(numbers, ends)]


def numbers(values: npt.ArrayLike) -> list[float | None]:
    """For JSON; null where a value is not finite."""
    return [number(value) for value in np.asarray(values, dtype=float).tolist()]


def number(value: float) -> float | None:
    """For JSON, with seven digits; null where it is not finite."""
    return float(f"{value:.7g}") if np.isfinite(value) else None
