"""Watching an arm at work: on a made-up link for the wiring, on the simulated arm's bus for the whole."""

from pathlib import Path

import numpy as np
import pytest
from fake_controllers import as_real32
from made_records import put_on

from armlink.arm_file import ArmFile, parse_arm
from armlink.link.link import Link
from armlink.link.types import Calibration, Command, DriveSerial, Sample
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import WorkMotion, work_targets
from calib.observer.config import ObserverConfig
from calib.observer.observer import observer_of
from calib.observer.recalibrator import Recalibrator
from calib.observer.watch_loop import WatchHistory, watch
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

NAMES = ("base", "shoulder", "elbow")
RATED = np.array([60.0, 60.0, 30.0])
MASS = np.array([4.0, 3.0, 1.5])
CENTRE = np.array([[0.0, 0.0, -0.1], [0.2, 0.02, 0.0], [0.15, 0.0, 0.01]])
PERIOD = 0.02
"""Of the made-up link; the simulated arm has its own 0.004 s."""
QUICK = ObserverConfig(window=12, baseline_rows=24)


def arm_file(gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)) -> ArmFile:
    """Three joints, axes 2 and 3 parallel; with this gravity every joint is loaded."""
    rows = [(0.0, 1.5708, 0.2), (0.4, 0.0, 0.0), (0.3, 0.0, 0.0)]
    joints = [
        {"name": name, "a": a, "alpha": alpha, "d": d, "lower": -1.4, "upper": 1.6}
        for name, (a, alpha, d) in zip(NAMES, rows, strict=True)
    ]
    link = [
        {"name": name, "node": k + 1, "rated_torque": float(rated), "max_torque": 1.4 * float(rated)}
        for k, (name, rated) in enumerate(zip(NAMES, RATED, strict=True))
    ]
    links = [
        {"mass": float(mass), "com": centre.tolist(), "inertia": [0.02, 0.02, 0.02]}
        for mass, centre in zip(MASS, CENTRE, strict=True)
    ]
    effects = [
        {"effect": "friction.coulomb", "joint": name, "torque": 0.02 * float(r)}
        for name, r in zip(NAMES, RATED, strict=True)
    ]
    content = {
        "name": "three",
        "serial": "3",
        "kinematics": {"gravity": list(gravity), "joints": joints},
        "link": {"joints": link},
        "sim": {"links": links, "effects": effects},
    }
    return parse_arm(content, Path("three.yaml"))


def records(arm: ArmFile, truth: Truth) -> tuple[CalibrationRecord, GravityRecord]:
    """What a good sweep would have found."""
    joints = tuple(
        JointCalibration(name=name, gain=g, offset=o, position_gain=p, position_offset=0.0)
        for name, g, o, p in zip(NAMES, truth.gain, truth.offset, truth.position_gain, strict=True)
    )
    beta = base_parameters(gcomp_arm(arm), MASS, MASS[:, None] * CENTRE)
    gravity = GravityRecord(
        **provenance(arm),
        names=NAMES,
        beta=tuple(beta + 1e-3),
        covariance=matrix(np.eye(6) * 1e-6),
        identifiable=(True,) * 6,
        gravity=arm.kinematics.gravity,
    )
    return CalibrationRecord(**provenance(arm), joints=joints), gravity


class MadeUpLink:
    """Goes where it is told at once; controllers apply what they hold; noise as a torque sensor has it."""

    def __init__(self, arm: ArmFile, truth: Truth) -> None:
        self.arm, self.beta = gcomp_arm(arm), base_parameters(gcomp_arm(arm), MASS, MASS[:, None] * CENTRE)
        self.position_gain, self.gain, self.offset = truth.position_gain, truth.gain.copy(), truth.offset.copy()
        self.held = [Calibration(1.0, 0.0) for _ in NAMES]
        self.random, self.t = np.random.default_rng(0), 0.0
        self.here, self.torque = np.full(3, np.nan), np.zeros(3)

    def cycle(self, command: Command) -> Sample:
        self.t += PERIOD
        if not np.array_equal(command.position, self.here):
            self.here = command.position
            self.torque = gravity_torque(self.arm, self.beta, self.here * self.position_gain)
        reading = self.gain * self.torque + self.offset + 2e-3 * RATED * self.random.normal(size=3)
        held = np.array([(one.gain, one.offset) for one in self.held])
        nothing = np.full(3, np.nan)
        sent = (reading - held[:, 1]) / held[:, 0]
        return Sample(self.t, command.position, nothing, sent, nothing, np.zeros(3, dtype=np.int64), np.zeros(3))

    def drive_serial(self, joint: int) -> DriveSerial:
        return DriveSerial(f"1:1:{joint}")

    def read_calibration(self, joint: int) -> Calibration:
        return self.held[joint]

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        self.held[joint] = as_real32(calibration)
        return self.held[joint]


class Setup:
    """A made-up arm with its records in force, observed at quick work."""

    def __init__(self, tmp_path: Path) -> None:
        arm = arm_file()
        truth = Truth.draw(arm, 3)
        self.link = MadeUpLink(arm, truth)
        self.record, gravity = records(arm, truth)
        self.store = RecordStore(str(tmp_path / "records.db"))
        self.store.put(self.record, arm, by="ann", reason="sweep")
        put_on(self.link, self.record)
        self.arm = arm
        self.observer = observer_of(self.link.arm, self.record, gravity, RATED, QUICK)
        self.recalibrator: Recalibrator | None = Recalibrator(arm, self.link, self.store)  # type: ignore[arg-type]

    def watch(self, seconds: float) -> WatchHistory:
        arm, random = self.link.arm, np.random.default_rng(int(1000 * self.link.t))
        targets = work_targets(np.zeros(3), arm.lower, arm.upper, np.ones(3), PERIOD, random)
        return watch(self.link, self.observer, targets, seconds, self.recalibrator)

    def drift(self) -> None:
        self.link.gain[1] *= 1.03
        self.link.offset[1] += 0.3


def test_apply_puts_a_drifted_sensor_right(tmp_path: Path) -> None:
    setup = Setup(tmp_path)
    assert setup.watch(50).events == []
    setup.drift()
    history = setup.watch(90)
    ((_, done),) = history.recalibrations[:1]
    assert done.joint == "shoulder"
    held = setup.link.held[1]
    assert held.gain / setup.link.gain[1] == pytest.approx(1.0, abs=0.003)
    assert held.offset == pytest.approx(setup.link.offset[1], abs=0.05)
    current = setup.store.current(CalibrationRecord, setup.arm)
    assert current is not None
    assert current.number == held.record_id
    assert len(history.t) == len(history.gain) == len(history.offset_std) > 30
    alarm, written = history.first("alarm"), history.first("recalibration")
    assert alarm is not None
    assert written is not None
    assert alarm < written == history.recalibrations[0][0]


@pytest.mark.long
def test_without_a_recalibrator_nothing_is_written(tmp_path: Path) -> None:
    setup = Setup(tmp_path)
    setup.recalibrator = None
    setup.watch(50)
    setup.drift()
    history = setup.watch(90)
    assert [event for event in history.events if event.kind == "proposal"]
    assert history.recalibrations == []
    assert setup.link.held[1].record_id == setup.record.number


def test_a_refused_recalibration_is_an_event(tmp_path: Path) -> None:
    setup = Setup(tmp_path)
    setup.watch(50)
    setup.link.gain[1] *= 1.2
    history = setup.watch(90)
    assert "a drift is at most 10%" in next(e.evidence["reason"] for e in history.events if e.kind == "refused")
    assert history.recalibrations == []


def test_work_stays_inside_the_range_at_the_speed_allowed() -> None:
    lower, upper, start = np.array([-1.0, 0.0]), np.array([1.0, 0.5]), np.array([0.95, 0.1])
    motion = WorkMotion()
    targets = work_targets(start, lower, upper, np.array([1.0, 0.5]), 0.004, np.random.default_rng(1), motion)
    path = np.array([start, *(next(targets) for _ in range(20_000))])
    inside = path[2000:]
    assert (inside >= lower + motion.margin - 1e-9).all()
    assert (inside <= upper - motion.margin + 1e-9).all()
    assert (np.abs(np.diff(path, axis=0)) / 0.004 <= motion.speed_share * np.array([1.0, 0.5]) * 1.05).all()
    still = np.abs(np.diff(path, axis=0)).max(axis=1) == 0
    stops = np.flatnonzero(np.diff(still.astype(int)) == 1)
    assert 1.0 < 20_000 * 0.004 / len(stops) < 2.5  # a pose about every two seconds


@pytest.mark.long
def test_on_the_simulated_arm_a_drift_is_found_and_put_right(tmp_path: Path) -> None:
    """Frames, physics, friction, quantisation and noise as the simulated arm has them."""
    arm, seed = arm_file(), 1
    truth = Truth.draw(arm, seed)
    simulated = SimulatedArm(arm, truth, seed)
    record, gravity = records(arm, truth)
    store = RecordStore(str(tmp_path / "records.db"))
    store.put(record, arm, by="ann", reason="sweep")
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        put_on(link, record)
        described = gcomp_arm(arm)
        observer = observer_of(described, record, gravity, RATED, QUICK)
        recalibrator = Recalibrator(arm, link, store)
        random = np.random.default_rng(seed)
        limits = (described.lower, described.upper, np.ones(3), link.period, random)
        targets = work_targets(link.position_sent, *limits)
        assert watch(link, observer, targets, 30, recalibrator).recalibrations == []
        simulated.drift("shoulder", 1.03, 0.3)
        history = watch(link, observer, targets, 60, recalibrator)
        held, true = link.read_calibration(1), simulated.true_sensors
    assert {done.joint for _, done in history.recalibrations} == {"shoulder"}
    assert held.gain / true.gain[1] == pytest.approx(1.0, abs=0.003)
    assert held.offset == pytest.approx(true.offset[1], abs=0.05)
