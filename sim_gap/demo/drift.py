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
from sim_gap.demo.script import (
    DRIFT_GAIN,
    DRIFT_OFFSET,
    DRIFT_OFFSET_SHARE,
    QUIET_SECONDS,
    SETTLED_SECONDS,
    WORK_SECONDS,
)


@dataclass(frozen=True, eq=False)
class Drift:
    """Course of the drift."""

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


def run_drift(
    bench: Bench,
    store: RecordStore,
    gravity: GravityRecord,
    check: Verification,
    seed: int,
    report: Report,
) -> Drift:
    """Let the arm work, change one sensor, and watch until the observer has put it right or the time is over."""
    link, described = bench.link, bench.described
    calibration = store.current(CalibrationRecord, bench.arm)
    assert calibration is not None
    recalibrator = Recalibrator(bench.arm, link, store, "apply")
    limits = bench.arm.require_link().joints
    rated = bench.arm.require_link().rated_torques
    observer = Observer.of_records(described, calibration, gravity, rated)
    joint = drifting_joint(calibration, check, rated)
    offset = min(DRIFT_OFFSET, DRIFT_OFFSET_SHARE * limits[joint].rated_torque)
    speed = np.array([each.max_velocity for each in limits])
    state = _Course(report, bench, joint, offset)
    history = watch(
        link,
        observer,
        work_targets(
            link.position_sent,
            described.lower,
            described.upper,
            speed,
            link.period,
            np.random.default_rng([seed, 8]),
            WorkMotion.of_drives(with_integral=all(setup.gains is None for setup in link.setups)),
        ),
        WORK_SECONDS,
        recalibrator,
        state,
    )
    name = link.names[joint]
    return Drift(
        joint,
        DRIFT_GAIN,
        offset,
        state.began,
        _first(history, name, ("alarm", "outliers"), state.began),
        next((t for t, outcome in history.recalibrations if outcome.joint == name and outcome.applied), None),
        state.error_before,
        bench.sensor_error(joint),
        history,
    )


def drifting_joint(calibration: CalibrationRecord, check: Verification, rated: Array) -> int:
    """The third joint, if gravity moves its torque as well as any other's; else the one that it moves most."""
    spread = np.where(np.isnan(calibration.values("gain")), 0.0, check.model.std(axis=0)) / rated
    third = min(2, len(spread) - 1)
    return third if spread[third] >= 0.3 * spread.max() else int(np.argmax(spread))


class _Course:
    """Called with every sample: makes the sensor drift when its time has come, and ends the watch."""

    def __init__(self, report: Report, bench: Bench, joint: int, offset: float) -> None:
        self._report, self._bench, self._joint, self._offset = report, bench, joint, offset
        self._start: float | None = None
        self.began = np.inf
        self.error_before = (0.0, 0.0)

    def __call__(self, sample: Sample, history: WatchHistory) -> bool:
        if self._start is None:
            self._start = sample.t
        if self.began == np.inf and sample.t - self._start >= QUIET_SECONDS:
            self.began = sample.t
            self._bench.simulated.drift(self._joint, DRIFT_GAIN, self._offset)
            self.error_before = self._bench.sensor_error(self._joint)
        written = [t for t, outcome in history.recalibrations if outcome.applied]
        if int(sample.t * 10) % 10 == 0:
            doing = (
                "the arm works" if self.began == np.inf else "the sensor has drifted" if not written else "put right"
            )
            self._report(sample.t - self._start, WORK_SECONDS, None, doing)
        return bool(written) and sample.t - written[-1] >= SETTLED_SECONDS


def _first(history: WatchHistory, joint: str, kinds: tuple[str, ...], after: float) -> float | None:
    found = [t for kind in kinds if (t := history.first(kind, joint, after)) is not None]
    return min(found, default=None)
