"""Campaign: sensor fits of realistic arms at levels 0, 1 and 3, judged by their error, intervals and told doubt.

    .venv/bin/python tests/campaigns/realism.py --seeds 1 38

Readings come from the simulated arm's own physics at rest (tests/calib/realistic_sweeps.py), so that an arm takes
seconds; --full sweeps on the simulated bus instead, some minutes an arm. Exit status 1 where a bound is broken.
"""

import argparse
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_arms import BUNDLED, asked_arm, sweep
from realistic_sweeps import RestingArm, both_passes, plans

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import SensorFit, fit_sensors
from gcomp.gravity.torque import gravity_torque, torque_covariance
from sim_bus.sim_section import with_realism
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

LEVELS = (0.0, 1.0, 3.0)
MEDIAN = {0.0: 0.0015, 1.0: 0.004, 3.0: 0.01}
"""Largest median error of a gain at each level."""
COVERAGE = (0.93, 0.97)
PARAMETERS = ("gain", "offset", "position_gain")
POSES = 60


@dataclass
class Outcome:
    """What one arm came to at one level."""

    error: np.ndarray
    """Of the gains that were found, as ratios."""
    inside: dict[str, list[bool]]
    left: np.ndarray
    """RMS of calibrated torque minus model at random poses, in rated torques (n,)."""
    told: np.ndarray
    """The same as the records expect it (n,)."""
    gravity: np.ndarray
    """RMS of the model's gravity torque against the truth over what it is told to be (n,)."""
    doubtful: tuple[str, ...]


def judge(arm: ArmFile, truth: Truth, data: list[SweepData], resting: RestingArm) -> Outcome:
    """The fit against the truth, and against new readings at poses that it has not seen."""
    fit = fit_sensors(arm, data)
    inside = {name: [] for name in PARAMETERS}
    for name in PARAMETERS:
        for (low, high), true in zip(fit.ci95(name), getattr(truth, name), strict=True):
            if np.isfinite(low):
                inside[name].append(bool(low <= true <= high))
    found = fit.value("gain")
    error = np.abs(found / truth.gain - 1)[np.isfinite(found)]
    none = np.full(len(found), np.nan)
    left, told, gravity = (none, none, none) if not len(error) else _new_poses(arm, truth, data, fit, resting)
    return Outcome(error, inside, left, told, gravity, fit.doubtful)


def _new_poses(
    arm: ArmFile, truth: Truth, data: list[SweepData], fit: SensorFit, resting: RestingArm
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    described, rated = gcomp_arm(arm), arm.require_link().rated_torques
    moments, record = identify_gravity(arm, data, fit), fit.record(arm)
    random, free = np.random.default_rng(9), np.full(described.n, np.nan)
    low, high = described.lower + 0.1, described.upper - 0.1
    begin = resting.time
    readings = []
    for pose in random.uniform(low, high, (POSES, described.n)):
        resting.time = begin  # the zero of the end of the sweeps
        readings.append(resting.read(resting.sensors.reading_of(pose), free, seconds=0.0)[:2])
    shown, torque = (np.array(each) for each in zip(*readings, strict=True))
    angle = record.angle(shown)
    model = gravity_torque(described, moments.beta, angle)
    error = record.torque_calibration().invert(torque) - model
    variance = np.diagonal(torque_covariance(described, moments.covariance, angle), axis1=1, axis2=2).mean(axis=0)
    level = record.discrepancy("level")
    gain = record.values("gain", 1.0)
    of_sensor = np.nan_to_num(record.std("gain")) ** 2 * (model**2).mean(axis=0)
    of_sensor = (of_sensor + np.nan_to_num(record.std("offset")) ** 2 + resting.sensors.noise**2) / gain**2
    told = np.sqrt(level**2 + variance + of_sensor)
    true = resting.simulated.gravity_torque(resting.sensors.angle_of(shown))
    of_model = np.sqrt(((model - true) ** 2).mean(axis=0))
    largest = np.abs(true).max(axis=0)
    share = np.where(largest > 1e-3 * rated, of_model / np.sqrt(level**2 + variance), np.nan)
    return np.sqrt((error**2).mean(axis=0)) / rated, told / rated, share


def outcomes(name: str, full: bool, levels: tuple[float, ...]) -> dict[float, Outcome]:
    """One arm, named or by the number of its seed, at every level."""
    arm, truth = asked_arm(name)
    seed = 1 if name in BUNDLED else int(name)
    planned, found = None if full else plans(arm, truth), {}
    for level in levels:
        real = with_realism(arm, level, seed)
        if planned is None:
            simulated = SimulatedArm(real, truth, seed)
            with tempfile.TemporaryDirectory() as scratch:
                data = sweep(simulated, Path(scratch))
                resting = RestingArm(simulated, seed)
                resting.time = simulated.time
                found[level] = judge(arm, simulated.true_sensors, data, resting)
        else:
            found[level] = judge(arm, *both_passes(real, truth, planned, seed))
    return found


def summary(level: float, done: list[Outcome]) -> bool:
    """Tell what a level came to; whether it is within the bounds."""
    error = np.concatenate([each.error for each in done])
    inside = {name: [held for each in done for held in each.inside[name]] for name in PARAMETERS}
    every = [held for held_of in inside.values() for held in held_of]
    share, chance = float(np.mean(every)), 2 * math.sqrt(0.95 * 0.05 / len(every))
    left, told = (np.concatenate([getattr(each, key) for each in done]) for key in ("left", "told"))
    ratio = np.concatenate([each.gravity for each in done])
    ratio, left_over = ratio[np.isfinite(ratio)], (left / told)[np.isfinite(left)]
    median = float(np.median(error))
    each = ", ".join(f"{name} {np.mean(inside[name]):.1%}" for name in PARAMETERS)
    doubtful = sum(bool(one.doubtful) for one in done)
    print(
        f"level {level:g}: gain error median {median:.3%} (asked {MEDIAN[level]:.2%}), nine in ten below"
        f" {np.percentile(error, 90):.2%}; {share:.1%} of {len(every)} intervals hold (by chance ± {chance:.1%}):"
        f" {each}; left at new poses, median {np.nanmedian(left):.3%} of rated torque, told {np.nanmedian(told):.3%},"
        f" RMS of left over told {np.sqrt(np.mean(left_over**2)):.2f}; gravity against the truth over what is told:"
        f" RMS {np.sqrt(np.mean(ratio**2)):.2f}, {np.mean(ratio < 1.96):.1%} below 1.96; doubtful arms {doubtful}",
        flush=True,
    )
    return (
        median <= MEDIAN[level]
        and COVERAGE[0] - chance <= share <= COVERAGE[1] + chance
        and float(np.mean(ratio < 1.96)) >= 0.9
    )


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 38), metavar=("FIRST", "LAST"))
    parser.add_argument("--only-random", action="store_true", help="leave the bundled arms out")
    parser.add_argument("--full", action="store_true", help="sweep on the simulated bus")
    parser.add_argument("--levels", type=float, nargs="+", default=LEVELS)
    given = parser.parse_args()
    names = [str(seed) for seed in range(given.seeds[0], given.seeds[1] + 1)]
    names = names if given.only_random else [*names, *BUNDLED]
    done: dict[float, list[Outcome]] = {level: [] for level in given.levels}
    for name in names:
        for level, outcome in outcomes(name, given.full, tuple(given.levels)).items():
            done[level].append(outcome)
            held = [each for values in outcome.inside.values() for each in values]
            worst = outcome.error.max(initial=0.0)
            print(
                f"{name:>9} level {level:g}: largest gain error {worst:.2%}, {sum(held)}/{len(held)} hold, left"
                f" {np.nanmax(outcome.left, initial=0.0):.2%} of rated torque at most, told"
                f" {np.nanmax(outcome.told, initial=0.0):.2%}; doubtful: {' '.join(outcome.doubtful) or 'none'}",
                flush=True,
            )
    verdicts = [summary(level, each) for level, each in done.items()]
    return int(not all(verdicts))


if __name__ == "__main__":
    sys.exit(main())
