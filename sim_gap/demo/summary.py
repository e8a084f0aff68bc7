"""The demo's result, and its form for machines (`summary.json`, schema armlink.demo/1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from armlink.link.types import Stats
from calib.fit.gravity_fit import GravityFit
from calib.fit.sensor_fit import SensorFit
from calib.records.records import Parameter
from calib.sweep.verify import Verification
from sim_bus.truth import Truth
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.bench import Bench, GravityCheck
from sim_gap.demo.drift import Drift

SCHEMA = "armlink.demo/1"
SHOWN: tuple[tuple[Parameter, int], ...] = (("gain", 4), ("offset", 3), ("position_gain", 5))
"""Sensor parameters that the demo draws and finds, with the digits to show."""


@dataclass(frozen=True, eq=False)
class DemoRun:
    """Setting, hidden truth and measurements of a demo, whatever the arm's drives."""

    bench: Bench
    """With the truth as it was after the sweeps."""
    seed: int
    gravity_check: GravityCheck
    verify: Verification
    gap: Diagnosis
    bus: Stats
    wall_s: float
    sim_s: float

    @property
    def arm(self) -> str:
        """Name of the arm file."""
        return self.bench.arm.name

    @property
    def names(self) -> tuple[str, ...]:
        """Joints, base to tip."""
        return self.bench.link.names

    @property
    def truth(self) -> Truth:
        """Of the sensors."""
        return self.bench.truth

    def to_json(self, found: dict[str, Any]) -> dict[str, Any]:
        """The summary; `found` is what only this kind of demo has. Null where a value cannot be determined."""
        check, bus = self.gravity_check, self.bus
        return {
            "schema": SCHEMA,
            "arm": self.arm,
            "seed": self.seed,
            "joints": list(self.names),
            **found,
            "gravity": {
                "poses": check.poses,
                "max_torque": numbers(check.max_torque),
                "rms_error": numbers(check.rms_error),
                "max_abs_error": numbers(check.max_abs_error),
            },
            "verify": {"poses": len(self.verify.position), "rms": numbers(self.verify.rms)},
            "gap": self.gap.to_json(),
            "bus": {
                "frames": bus.frames,
                "rate_hz": number(bus.rate_hz),
                "load": number(bus.load),
                "missed": bus.missed,
            },
            "wall_s": number(self.wall_s),
            "sim_s": number(self.sim_s),
        }


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Demo of an arm with torque sensors, one of which drifts."""

    run: DemoRun
    sensors: SensorFit
    gravity: GravityFit
    drift: Drift


def summary(result: DemoResult) -> dict[str, Any]:
    """`summary.json` of an arm with torque sensors."""
    drift = result.drift
    return result.run.to_json(
        {
            "sensors": {
                name: {
                    "true": numbers(getattr(result.run.truth, name)),
                    "estimated": numbers(result.sensors.value(name)),
                    "ci95": [None if row[0] is None else row for row in map(numbers, result.sensors.ci95(name))],
                }
                for name, _ in SHOWN
            },
            "not_identifiable": {
                f"{joint}.{parameter}": reason for (joint, parameter), reason in result.sensors.reasons.items()
            },
            "drift": {
                "joint": result.run.names[drift.joint],
                "gain": drift.gain,
                "offset": drift.offset,
                "detected_after_s": None if drift.detected is None else number(drift.detected - drift.began),
                "recalibrated": drift.recalibrated is not None,
                "recalibrated_after_s": None
                if drift.recalibrated is None
                else number(drift.recalibrated - drift.began),
                "gain_error_after": number(abs(drift.error_after[0])),
                "offset_error_after": number(abs(drift.error_after[1])),
            },
        }
    )


def numbers(values: npt.ArrayLike) -> list[float | None]:
    """For JSON; null where a value is not finite."""
    return [number(value) for value in np.asarray(values, dtype=float).tolist()]


def number(value: float) -> float | None:
    """For JSON, with seven digits; null where it is not finite."""
    return float(f"{value:.7g}") if np.isfinite(value) else None
