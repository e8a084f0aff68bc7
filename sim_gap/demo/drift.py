"""The demo's drift: a torque sensor changes while the arm works, the observer finds it and recalibrates by itself."""

from dataclasses import dataclass

import numpy as np

from armlink.link.types import Sample
from calib.motion.random_work import WorkMotion, work_targets
from calib.observer.observer import Observer
from calib.observer.recalibrator import Recalibrator
from calib.observer.watch_loop import WatchHistory, watch
from calib.records.records import CalibrationRecord, GravityRecord
from calib.records.store import RecordStore
from calib.sweep.verify import Verification
from gcomp.arrays import Array
from sim_gap.demo.bench import Bench
from sim_gap.demo.narrator import Report

DRIFT_GAIN, DRIFT_OFFSET, DRIFT_OFFSET_SHARE = 1.03, 0.3, 0.05
"""Factor on the sensor's readings; offset added to them [N·m], at most this share of rated torque."""
QUIET_SECONDS, WORK_SECONDS, WATCHED_SECONDS = 30.0, 300.0, 15.0
"""Ordinary work before the drift begins, at most, and after a recalibration [s]."""


@dataclass(frozen=True, eq=False)
class DriftCourse:
    joint: int
    gain: float
    offset: float
    """[N·m]."""
    began: float
    """Link time at which the sensor changed [s]."""
    detected: float | None
    recalibrated: float | None
    """Link times [s]; None where it did not happen."""
    error_before: tuple[float, float]
    """(Gain, offset [N·m]) error of the joint's readings right after the drift."""
    error_after: tuple[float, float]
    """The same at the end."""
    history: WatchHistory

    def sentence(self, names: tuple[str, ...]) -> str:
        drifted = f"{names[self.joint]} drifted by {self.gain - 1:+.0%} gain and {self.offset:+.2f} N·m"
        if self.detected is None:
            return f"{drifted}: not detected"
        seen = f"{drifted}: noticed after {self.detected - self.began:.1f} s"
        if self.recalibrated is None:
            return f"{seen}, not recalibrated"
        gain, offset = self.error_after
        return (
            f"{seen}, recalibrated by itself after {self.recalibrated - self.began:.0f} s of work;"
            f" error now {gain:+.2%} and {offset:+.3f} N·m"
        )


def run_drift(
    bench: Bench, store: RecordStore, gravity: GravityRecord, check: Verification, seed: int, report: Report
) -> DriftCourse:
    """Let the arm work, change one sensor, and watch until the observer has put it right or the time is over."""
    link, described = bench.link, bench.described
    calibration = store.current(CalibrationRecord, bench.arm)
    assert calibration is not None
    recalibrator = Recalibrator(bench.arm, link, store, "apply")
    limits, rated = bench.arm.require_link().joints, bench.arm.require_link().rated_torques
    observer = Observer.of_records(described, calibration, gravity, rated)
    joint = drifting_joint(calibration, check, rated)
    offset = min(DRIFT_OFFSET, DRIFT_OFFSET_SHARE * limits[joint].rated_torque)
    targets = work_targets(
        link.position_sent,
        described.lower,
        described.upper,
        np.array([each.max_velocity for each in limits]),
        link.period,
        np.random.default_rng([seed, 8]),
        WorkMotion.of_drives(with_integral=all(setup.gains is None for setup in link.setups)),
    )
    start: float | None = None
    began, error_before = np.inf, (0.0, 0.0)

    def course(sample: Sample, history: WatchHistory) -> bool:
        """Make the sensor drift when its time has come; whether the watch is over."""
        nonlocal start, began, error_before
        start = sample.t if start is None else start
        if began == np.inf and sample.t - start >= QUIET_SECONDS:
            began = sample.t
            bench.simulated.drift(joint, DRIFT_GAIN, offset)
            error_before = bench.sensor_error(joint)
        written = [t for t, outcome in history.recalibrations if outcome.applied]
        if int(sample.t * 10) % 10 == 0:
            drifted = "put right" if written else "the sensor has drifted"
            report(sample.t - start, WORK_SECONDS, None, "the arm works" if began == np.inf else drifted)
        return bool(written) and sample.t - written[-1] >= WATCHED_SECONDS

    history = watch(link, observer, targets, WORK_SECONDS, recalibrator, course)
    name = link.names[joint]
    noticed = [t for kind in ("alarm", "outliers") if (t := history.first(kind, name, began)) is not None]
    written = [t for t, outcome in history.recalibrations if outcome.joint == name and outcome.applied]
    return DriftCourse(
        joint,
        DRIFT_GAIN,
        offset,
        began,
        min(noticed, default=None),
        next(iter(written), None),
        error_before,
        bench.sensor_error(joint),
        history,
    )


def drifting_joint(calibration: CalibrationRecord, check: Verification, rated: Array) -> int:
    """The third joint, if gravity moves its torque as well as any other's; else the one that it moves most."""
    spread = np.where(np.isnan(calibration.values("gain")), 0.0, check.model.std(axis=0)) / rated
    third = min(2, len(spread) - 1)
    return third if spread[third] >= 0.3 * spread.max() else int(np.argmax(spread))
