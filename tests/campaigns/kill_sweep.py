"""SIGKILL a sweep at random moments and resume it, until it is done: the data must be those of a sweep left alone.

    .venv/bin/python tests/campaigns/kill_sweep.py --kills 200

Each attempt is a process of its own with a freshly powered-on arm, as after a power cut. Afterwards every reading
must be there exactly once, none torn, and differ from an undisturbed sweep's by no more than its own standard error
explains.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from sweep_arms import random_arm, with_section

from armlink.arm_file import ArmFile
from armlink.link.link import Link
from calib.dataset import SweepData, load_data
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

FARTHEST, SPREAD = 7.0, (0.5, 1.6)
"""Largest difference and root mean square of the differences that pass, in their own standard deviations."""
FLOOR = 2e-4
"""What a joint's place within its servo's dead band does to a reading, as a share of rated torque."""


def bench() -> ArmFile:
    """Two joints, few steps."""
    return with_section(
        random_arm(31, 2), steps=5, poses=1, max_samples=10, settle_window=0.08, gain_std=0.5, travel_speed=0.95
    )


def sweep(arm: ArmFile, out: Path, seed: int) -> None:
    """One attempt, on an arm that has just been switched on."""
    with Link(arm, LockStepBus(arm=SimulatedArm(arm, Truth.draw(arm, 3), seed))) as link:
        link.start()
        link.enable()
        run_sweep(link, arm, out, resume=(out / "manifest.json").exists(), seed=0)


def killed(arm: ArmFile, out: Path, seed: int, after: float) -> bool:
    """Whether an attempt in a process of its own was still under way `after` seconds [s] and was killed."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            sweep(arm, out, seed)
            status = 0
        finally:
            os._exit(status)
    deadline = time.monotonic() + after
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            if status:
                raise SystemExit(f"{out}: an attempt failed with status {status}")
            return False
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def compare(reference: SweepData, data: SweepData) -> tuple[list[str], np.ndarray]:
    """(What is wrong, differences of the swept joints' torques in their standard deviations)."""
    wrong = []
    made = [(reading.sweep, reading.index) for reading in data.readings]
    expected = [(reading.sweep, reading.index) for reading in reference.readings]
    if sorted(made) != sorted(expected):
        wrong.append(f"{len(made)} readings, expected {len(expected)}, each once")
    by_key = {(reading.sweep, reading.index): reading for reading in data.readings}
    scores = []
    for one in reference.readings:
        other = by_key.get((one.sweep, one.index))
        if other is None or one.joint is None:
            continue
        j = one.joint
        error = np.hypot(one.torque_std[j] / np.sqrt(one.count), other.torque_std[j] / np.sqrt(other.count))
        error = np.hypot(error, FLOOR * reference.manifest.rated_torque[j])
        scores.append((other.torque[j] - one.torque[j]) / error)
    if scores and np.abs(scores).max() > FARTHEST:
        wrong.append(f"a reading differs by {np.abs(scores).max():.1f} standard deviations")
    return wrong, np.array(scores)


def campaign(kills: int, seed: int, folder: Path) -> tuple[int, int, list[str], np.ndarray]:
    """(Kills, sweeps finished, what is wrong, all differences)."""
    arm, random = bench(), np.random.default_rng(seed)
    began = time.monotonic()
    sweep(arm, folder / "alone", 1)
    took = time.monotonic() - began
    reference = load_data(folder / "alone")
    made, sweeps, wrong, scores = 0, 0, list[str](), list[np.ndarray]()
    while made < kills:
        sweeps += 1
        out = folder / f"killed-{sweeps}"
        while True:
            patience = float(random.uniform(0, 0.6 * took)) if made < kills else 1e9
            if not killed(arm, out, int(random.integers(2**31)), patience):
                break
            made += 1
        found, differences = compare(reference, load_data(out))
        wrong += found
        scores.append(differences)
        rms = float(np.sqrt(np.mean(np.concatenate(scores) ** 2)))
        print(f"sweep {sweeps}: {made} kills so far, differences {rms:.2f} rms; {'; '.join(found) or 'ok'}", flush=True)
    return made, sweeps, wrong, np.concatenate(scores)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        made, sweeps, wrong, scores = campaign(given.kills, given.seed, Path(scratch))
    rms = float(np.sqrt(np.mean(scores**2)))
    print(
        f"{made} kills in {sweeps} sweeps, every one finished by resuming; {len(scores)} readings differ from an"
        f" undisturbed sweep's by {rms:.2f} standard deviations rms, {np.abs(scores).max():.2f} at most;"
        f" {'; '.join(wrong) or 'ok'}"
    )
    return int(bool(wrong) or not SPREAD[0] < rms < SPREAD[1])


if __name__ == "__main__":
    sys.exit(main())
