"""The demo's bench: a simulated arm with a hidden truth, the link to it, and motions and checks of the demo's own."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.orders import Mode
from armlink.extras import has_extra
from armlink.link.link import Link
from armlink.link.types import Command, Sample
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from armlink.torque_calibration import TorqueCalibration
from calib.motion.trajectory import trajectory
from calib.plan.types import SweepPlan
from calib.records.records import CalibrationRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.batch import GravityModel
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.narrator import Report
from sim_gap.model.load import compile_model

TONES, TONE_BAND_HZ = 3, (0.08, 0.3)
"""Number of sines per joint in the recorded motion, and their frequencies [Hz]."""
FADE_S = 2.0
"""Time over which the motion begins [s]."""
RANGE_SHARE = 0.35
"""Amplitude of the recorded motion at most, as a share of half the joint's range."""
SPEED_SHARE = 0.6
"""Speed at most, as a share of the joint's max_velocity."""
ACCELERATION = 1.0
"""At most [rad/s²], for drives that have little torque left over gravity."""
WEAK_SHARE = 0.1
"""Of the arm file's gains, under which joints sag."""


@dataclass(frozen=True, eq=False)
class Bench:
    """The bench: arm, link and truth. Estimates may use `link` alone; the rest is for checking afterwards."""

    arm: ArmFile
    described: Arm
    truth: Truth
    """The sensors as they are after the sweeps, effects of the arm file included."""
    simulated: SimulatedArm
    link: Link

    @classmethod
    def build(cls, arm: ArmFile, described: Arm, seed: int) -> "Bench":
        """A simulated arm with the truth of `seed` on an in-process bus; raises BadInput."""
        simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
        return cls(arm, described, simulated.true_sensors, simulated, Link(arm, LockStepBus(arm=simulated)))

    def sensor_error(self, joint: int) -> tuple[float, float]:
        """(Gain error, offset error [N·m]) of the readings that a joint's controller sends now, against the truth."""
        true = self.simulated.true_sensors
        sensor = TorqueCalibration(float(true.gain[joint]), float(true.offset[joint]))
        error = sensor.relative_to(self.link.read_calibration(joint))
        return error.gain - 1.0, error.offset


@dataclass(frozen=True, eq=False)
class GravityCheck:
    """The identified model against the plant's own gravity torque at random poses, (n,) [N·m]."""

    poses: int
    max_torque: Array
    rms_error: Array
    max_abs_error: Array


def check_gravity(bench: Bench, beta: Array, record: CalibrationRecord, seed: int, poses: int = 500) -> GravityCheck:
    """Compare at random true poses; the model is asked at the angles that the calibrated position sensors report."""
    described, truth = bench.described, bench.truth
    angles = np.random.default_rng(seed).uniform(described.lower, described.upper, (poses, described.n))
    reported = record.angle((angles - truth.position_offset) / truth.position_gain)
    true = bench.simulated.gravity_torque(angles)
    error = gravity_torque(described, beta, reported) - true
    rms = np.sqrt((error**2).mean(axis=0))
    return GravityCheck(poses, np.abs(true).max(axis=0), rms, np.abs(error).max(axis=0))


def multisine(bench: Bench, seconds: float, seed: int) -> Array:
    """Targets (K, n) [rad], one a cycle: each joint its own sum of sines about the middle of its range."""
    random = np.random.default_rng(seed)
    limits = bench.arm.require_link().joints
    low, high = bench.described.lower, bench.described.upper
    t = np.arange(int(seconds * bench.link.rate)) * bench.link.period
    fade = np.clip(t / FADE_S, 0.0, 1.0)
    fade = fade * fade * (3 - 2 * fade)
    targets = np.empty((len(t), bench.described.n))
    for joint in range(bench.described.n):
        omega = 2 * np.pi * random.uniform(*TONE_BAND_HZ, TONES)
        phase = random.uniform(0, 2 * np.pi, TONES)
        share = 1.0 / TONES
        amplitude = RANGE_SHARE * (high[joint] - low[joint]) / 2 * share
        speed = SPEED_SHARE * limits[joint].max_velocity * share
        size = np.minimum(amplitude, np.minimum(speed / omega, ACCELERATION * share / omega**2))
        waves = (size * np.sin(np.outer(t, omega) + phase)).sum(axis=1)
        targets[:, joint] = (low[joint] + high[joint]) / 2 + fade * waves
    return targets


def travel(bench: Bench, start: Array, goal: Array) -> None:
    """Bring all joints under position control from `start` to `goal` (n,) [rad]."""
    speed = np.array([SPEED_SHARE * joint.max_velocity for joint in bench.arm.require_link().joints])
    for target in trajectory(start, goal, speed, np.full(len(goal), ACCELERATION), bench.link.period):
        bench.link.cycle(Command.hold(target))


def record_pair(
    bench: Bench,
    calibration: CalibrationRecord,
    folder: Path,
    seed: int,
    seconds: tuple[float, float],
    report: Report,
    *,
    motor_only: bool = False,
) -> tuple[Recording, Recording]:
    """Two different motions to learn and to judge from, every cycle, positions as the calibration corrects them.

    They are kept as MCAP too, or as CSV without the extra for it; `motor_only`: without joint torque. Raises BusFault.
    """
    link, found = bench.link, []
    scale, zero = calibration.values("position_gain", 1.0), calibration.values("position_offset", 0.0)
    for number, (name, length) in enumerate(zip(("train", "heldout"), seconds, strict=True)):
        targets, rows = multisine(bench, length, seed=1000 * (seed + 1) + number), list[Sample]()
        travel(bench, link.position_sent, targets[0])
        for k, target in enumerate(targets):
            rows.append(link.cycle(Command.hold(target)))
            if k % 50 == 0:
                report(k, len(targets), None, name)
        recording = Recording(
            t=np.array([row.t for row in rows]) - rows[0].t,
            position=np.array([row.position for row in rows]) * scale + zero,
            torque=None if motor_only else np.array([row.torque for row in rows]),
            motor_torque=np.array([row.motor_torque for row in rows]),
            position_command=targets * scale + zero,
            names=link.names,
        ).check("recording of the simulated arm")
        save_recording(recording, folder / f"{name}{'.mcap' if has_extra('bags') else '.csv.gz'}")
        found.append(recording)
    return found[0], found[1]


def diagnose_recordings(arm_path: Path, recordings: tuple[Recording, Recording]) -> Diagnosis:
    """The recordings against the arm's nominal model, in another process."""
    return diagnose(compile_model(arm_path), recordings[:1], recordings[1:], labels=["train", "heldout"])


@dataclass(frozen=True, eq=False)
class Sag:
    """Mean absolute deflection from the poses held (n,) [rad]."""

    nominal: Array
    """With the model file's masses and torque as the drives take it."""
    calibrated: Array
    """With the records."""
    poses: int


class WeakHold:
    """Torque control: gravity fed forward, and a tenth of the gains about a pose; picklable."""

    def __init__(self, model: GravityModel, zero: Array, pose: Array, kp: Array, kd: Array) -> None:
        """`pose` and `zero` (n,) [rad] are readings and the offsets added to them."""
        self._model, self._zero, self._pose, self._kp, self._kd = model, zero, pose, kp, kd
        self._position = pose.copy()

    def command(self, sample: Sample) -> Command:
        np.copyto(self._position, sample.position, where=np.isfinite(sample.position))
        speed = np.nan_to_num(sample.velocity)
        torque = self._model.one(self._position + self._zero) + self._kp * (self._pose - self._position)
        return Command(np.full(len(torque), Mode.TORQUE, np.int8), torque - self._kd * speed, self._position.copy())


def sag_poses(plan: SweepPlan) -> Array:
    """Three poses to hold (3, n) [rad]: where creeps of the joints next to the base begin; home lies between them."""
    return np.array([sweep.rest for sweep in plan.sweeps[::-2][:3]])


def mean_sag(bench: Bench, plan: SweepPlan, beta: Array, zero: Array, seconds: float = 2.0) -> Array:
    """Mean deflection (n,) [rad] with the mass moments beta (2n,) [kg·m] and the zeros (n,) [rad] of position readings.

    Each pose is held for some `seconds`, of which the last half second counts. The joints hold at the end. Raises
    Refused where a joint runs away from its pose, BusFault.
    """
    link, home = bench.link, np.array(plan.scout[0])
    drives = [joint.settings for joint in bench.arm.require_link().joints]
    kp, kd = np.array([WEAK_SHARE * each.kp for each in drives]), np.array([each.kd for each in drives])
    model, away = GravityModel(bench.described, beta), []
    for pose in sag_poses(plan):
        travel(bench, link.position_sent, home)
        travel(bench, home, pose)
        held = []
        with closing(link.run(WeakHold(model, zero, pose, kp, kd))) as samples:
            for sample in samples:
                held.append(sample.position)
                if len(held) >= seconds * link.rate:
                    break
        seen = np.array(held[-round(0.5 * link.rate) :])
        away.append(np.abs(np.nanmean(seen, axis=0) - pose))
        link.cycle(Command.hold(np.where(np.isfinite(seen[-1]), seen[-1], pose)))
    return np.asarray(np.mean(away, axis=0))
