"""The demo's bench: a simulated arm with a hidden truth, the link to it, and motions and checks of the demo's own."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from armlink import Recording
from armlink.arm_file import ArmFile
from armlink.drives.orders import Mode
from armlink.link.link import Link
from armlink.link.types import Command, Sample
from armlink.recording.files import save_recording
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_motion
from calib.motion.trajectory import trajectory
from calib.plan.types import SweepPlan
from calib.records.records import CalibrationRecord
from calib.sweep.verify import Verification
from gcomp.arrays import Array
from gcomp.gravity.batch import GravityModel
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth
from sim_gap.experiment import MOVES, multisine

TONES, TONE_BAND_HZ = 3, (0.08, 0.3)
"""Number of sines per joint in the recorded motion, and their frequencies [Hz]."""
RANGE_SHARE, SPEED_SHARE = 0.35, 0.6
"""At most: amplitude, as a share of half the range; speed, of max_velocity."""
WEAK_SHARE = 0.1
"""Of the arm file's gains, under which joints sag."""


class Bench:
    """Estimates may use `link` alone; the simulated arm is for the operator's hands, and for checking afterwards."""

    def __init__(self, arm: ArmFile, seed: int) -> None:
        """A simulated arm with the truth of `seed` on an in-process bus; raises BadInput."""
        self.arm, self.described, self.creeping = arm, gcomp_arm(arm), sweep_motion(arm) == "creep"
        self.speed = SPEED_SHARE * np.array([joint.max_velocity for joint in arm.require_link().joints])
        self.simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
        self.link = Link(arm, LockStepBus(arm=self.simulated))

    def travel(self, start: Array, goal: Array) -> None:
        """Bring all joints under position control from `start` to `goal` (n,) [rad]."""
        for target in trajectory(start, goal, self.speed, np.full(len(goal), MOVES.acceleration), self.link.period):
            self.link.cycle(Command.hold(target))

    def sensor_error(self, joint: int) -> tuple[float, float]:
        """(Gain error, offset error [N·m]) of the readings that a joint's controller sends now, against the truth."""
        true = self.simulated.true_sensors
        sensor = TorqueCalibration(float(true.gain[joint]), float(true.offset[joint]))
        error = sensor.relative_to(self.link.read_calibration(joint))
        return error.gain - 1.0, error.offset

    def gravity_errors(
        self, truth: Truth, beta: Array, record: CalibrationRecord, seed: int, poses: int = 500
    ) -> dict[str, Any]:
        """The model, at angles as calibrated sensors report them, against the truth at random poses, (n,) [N·m]."""
        described = self.described
        angles = np.random.default_rng(seed).uniform(described.lower, described.upper, (poses, described.n))
        reported = record.angle((angles - truth.position_offset) / truth.position_gain)
        true = self.simulated.gravity_torque(angles)
        error = gravity_torque(described, beta, reported) - true
        largest, rms = np.abs(true).max(axis=0), np.sqrt((error**2).mean(axis=0))
        return {"poses": poses, "max_torque": largest, "rms_error": rms, "max_abs_error": np.abs(error).max(axis=0)}

    def record_motion(
        self,
        seconds: float,
        seed: int,
        calibration: CalibrationRecord,
        path: Path,
        progress: Callable[[int, int, str], None],
    ) -> Recording:
        """Every cycle of a motion of its own, positions as the calibration corrects them; kept as MCAP too."""
        link, rows, low, high = self.link, list[Sample](), self.described.lower, self.described.upper
        t: Array = link.period * np.arange(int(seconds * link.rate), dtype=float)
        draw, reach = np.random.default_rng(seed).random((link.n, 2, TONES)), RANGE_SHARE * (high - low) / 2
        targets: Array = (low + high) / 2 + multisine(t, reach, self.speed, TONE_BAND_HZ, draw)
        self.travel(link.position_sent, targets[0])
        for k, target in enumerate(targets):
            rows.append(link.cycle(Command.hold(target)))
            progress(k + 1, len(targets), f"cycles of the recording {path.stem}")
        recording = Recording(
            t=np.array([row.t for row in rows]) - rows[0].t,
            position=calibration.angle(np.array([row.position for row in rows])),
            torque=None if self.creeping else np.array([row.torque for row in rows]),
            motor_torque=np.array([row.motor_torque for row in rows]),
            position_command=calibration.angle(targets),
            names=link.names,
        )
        save_recording(recording, path)
        return recording

    def mean_sag(self, plan: SweepPlan, beta: Array, zero: Array, seconds: float = 2.0) -> Array:
        """Mean deflection (n,) [rad] in the last half second of each pose; beta (2n,) [kg·m], zeros (n,) [rad]."""
        link, home, model, away = self.link, np.array(plan.scout[0]), GravityModel(self.described, beta), []
        drives = [joint.settings for joint in self.arm.require_link().joints]
        kp, kd = np.array([WEAK_SHARE * each.kp for each in drives]), np.array([each.kd for each in drives])
        for pose in sag_poses(plan):
            self.travel(link.position_sent, home)
            self.travel(home, pose)
            sample, held = link.cycle(link.last or Command.hold(pose)), list[Array]()
            while len(held) < seconds * link.rate:
                sample = link.cycle(weak_hold(sample, model, zero, pose, kp, kd))
                held.append(sample.position)
            seen = np.array(held[-round(0.5 * link.rate) :])
            away.append(np.abs(np.nanmean(seen, axis=0) - pose))
            link.cycle(Command.hold(np.where(np.isfinite(seen[-1]), seen[-1], pose)))
        return np.asarray(np.mean(away, axis=0))


def sag_poses(plan: SweepPlan) -> list[Array]:
    """Three poses to hold (n,) [rad]: where creeps of the joints next to the base begin; home lies between them."""
    return [np.array(sweep.rest) for sweep in plan.sweeps[::-2][:3]]


def weak_hold(sample: Sample, model: GravityModel, zero: Array, pose: Array, kp: Array, kd: Array) -> Command:
    """Gravity fed forward and weak gains about `pose` (n,) [rad]; `zero` (n,) [rad] is added to readings."""
    position = np.where(np.isfinite(sample.position), sample.position, pose)
    torque = model.one(position + zero) + kp * (pose - position) - kd * np.nan_to_num(sample.velocity)
    return Command(np.full(len(torque), Mode.TORQUE, np.int8), torque, position)


def drifting_joint(calibration: CalibrationRecord, check: Verification, rated: Array) -> int:
    """The third joint, if gravity moves its torque as well as any other's; else the one that it moves most."""
    spread = np.where(np.isnan(calibration.values("gain")), 0.0, check.model.std(axis=0)) / rated
    third = min(2, len(spread) - 1)
    return third if spread[third] >= 0.3 * spread.max() else int(np.argmax(spread))
