"""Motion for the gap's recordings: sums of sines within the joints' ranges and speeds, recorded through the link."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from armlink.link.types import Command
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from calib.motion.trajectory import trajectory
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array
from sim_gap.demo.bench import Bench
from sim_gap.demo.narrator import Report
from sim_gap.demo.script import ACCELERATION, BAND, FADE, RANGE_SHARE, SPEED_SHARE, TONES


def multisine(bench: Bench, seconds: float, seed: int) -> Array:
    """Targets (K, n) [rad], one a cycle: each joint its own sum of sines about the middle of its range."""
    random = np.random.default_rng(seed)
    limits = bench.arm.require_link().joints
    low, high = bench.described.lower, bench.described.upper
    t = np.arange(int(seconds * bench.link.rate)) * bench.link.period
    fade = np.clip(t / FADE, 0.0, 1.0)
    fade = fade * fade * (3 - 2 * fade)
    targets = np.empty((len(t), bench.described.n))
    for joint in range(bench.described.n):
        omega = 2 * np.pi * random.uniform(*BAND, TONES)
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
    limits = bench.arm.require_link().joints
    speed = np.array([SPEED_SHARE * joint.max_velocity for joint in limits])
    for target in trajectory(start, goal, speed, np.full(len(goal), ACCELERATION), bench.link.period):
        bench.link.cycle(Command.hold(target))


def record_pair(
    bench: Bench,
    calibration: CalibrationRecord,
    folder: Path,
    seed: int,
    seconds: tuple[float, float],
    report: Report,
    motor_only: bool = False,
) -> tuple[Recording, Recording]:
    """Two different motions to learn and to judge from, kept as MCAP too; `motor_only`: without joint torque."""
    found = []
    for number, (name, length) in enumerate(zip(("train", "heldout"), seconds, strict=True)):
        targets = multisine(bench, length, seed=1000 * (seed + 1) + number)
        travel(bench, bench.link.position_sent, targets[0])
        made = _record_motion(bench, targets, calibration, report, name)
        found.append(replace(made, torque=None) if motor_only else made)
        save_recording(found[-1], folder / f"{name}.mcap")
    return found[0], found[1]


def _record_motion(
    bench: Bench, targets: Array, calibration: CalibrationRecord, report: Report, text: str
) -> Recording:
    """Follow the targets and record every cycle, positions as the calibration corrects them; raises BusFault."""
    link = bench.link
    rows = []
    for k, target in enumerate(targets):
        rows.append(link.cycle(Command.hold(target)))
        if k % 50 == 0:
            report(k, len(targets), None, text)
    scale, zero = calibration.values("position_gain", 1.0), calibration.values("position_offset", 0.0)
    return Recording(
        t=np.array([row.t for row in rows]) - rows[0].t,
        position=np.array([row.position for row in rows]) * scale + zero,
        torque=np.array([row.torque for row in rows]),
        motor_torque=np.array([row.motor_torque for row in rows]),
        position_command=targets * scale + zero,
        names=link.names,
    ).check("recording of the simulated arm")
