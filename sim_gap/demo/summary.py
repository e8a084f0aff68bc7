"""The demo's result, and its form for machines (`summary.json`, schema armlink.demo/1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from armlink.link.types import Stats
from calib.fit.gravity_fit import GravityFit
from calib.fit.sensor_fit import SensorFit
from calib.records.records import Parameter
from calib.sweep.dataset import SweepData
from calib.sweep.verify import Verification
from gcomp.arm.arm import Arm
from sim_bus.truth import Truth
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.bench import GravityCheck
from sim_gap.demo.drift import Drift

SCHEMA = "armlink.demo/1"
SHOWN: tuple[tuple[Parameter, int], ...] = (("gain", 4), ("offset", 3), ("position_gain", 5))
"""Sensor parameters that the demo draws and finds, with the digits to show."""


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Everything that the demo found, beside the truth."""

    arm: str
    seed: int
    names: tuple[str, ...]
    described: Arm
    truth: Truth
    data: tuple[SweepData, ...]
    sensors: SensorFit
    gravity: GravityFit
    gravity_check: GravityCheck
    verify: Verification
    drift: Drift
    gap: Diagnosis
    bus: Stats
    wall_s: float
    sim_s: float


def summary(result: DemoResult) -> dict[str, Any]:
    """The contract's dictionary; null where a value cannot be determined."""
    drift, check = result.drift, result.gravity_check
    return {
        "schema": SCHEMA,
        "arm": result.arm,
        "seed": result.seed,
        "joints": list(result.names),
        "sensors": {
            name: {
                "true": _numbers(getattr(result.truth, name)),
                "estimated": _numbers(result.sensors.value(name)),
                "ci95": [None if row[0] is None else row for row in map(_numbers, result.sensors.ci95(name))],
            }
            for name, _ in SHOWN
        },
        "not_identifiable": {
            f"{joint}.{parameter}": reason for (joint, parameter), reason in result.sensors.reasons.items()
        },
        "gravity": {
            "poses": check.poses,
            "max_torque": _numbers(check.max_torque),
            "rms_error": _numbers(check.rms_error),
            "max_abs_error": _numbers(check.max_abs_error),
        },
        "verify": {"poses": len(result.verify.position), "rms": _numbers(result.verify.rms)},
        "drift": {
            "joint": result.names[drift.joint],
            "gain": drift.gain,
            "offset": drift.offset,
            "detected_after_s": None if drift.detected is None else _number(drift.detected - drift.began),
            "recalibrated": drift.recalibrated is not None,
            "recalibrated_after_s": None if drift.recalibrated is None else _number(drift.recalibrated - drift.began),
            "gain_error_after": _number(abs(drift.error_after[0])),
            "offset_error_after": _number(abs(drift.error_after[1])),
        },
        "gap": result.gap.to_json(),
        "bus": {
            "frames": result.bus.frames,
            "rate_hz": _number(result.bus.rate_hz),
            "load": _number(result.bus.load),
            "missed": result.bus.missed,
        },
        "wall_s": _number(result.wall_s),
        "sim_s": _number(result.sim_s),
    }


def _numbers(values: npt.ArrayLike) -> list[float | None]:
    return [_number(value) for value in np.asarray(values, dtype=float).tolist()]


def _number(value: float) -> float | None:
    return float(f"{value:.7g}") if np.isfinite(value) else None
