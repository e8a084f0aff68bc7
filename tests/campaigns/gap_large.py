"""Campaign: time of one processor and memory of a large diagnosis.

    python tests/campaigns/gap_large.py [--seconds 120]

A seven-joint arm at 250 Hz with all three torque channels and friction, a payload, a sensor's gain and load-dependent
friction, judged on another motion of half the length. Report, answer and model are written, as from the command line.
"""

import argparse
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "sim_gap"))
from wrong_arms import Wrong, record

from armlink.recording.files import save_recording
from sim_gap.model.load import load_model

ARM, RATE, NOISE_NM = "sarcos", 250.0, 0.02
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}


def make(folder: Path, seconds: float) -> None:
    """Training and held-out recordings of an arm with five effects."""
    random, n = np.random.default_rng(1), load_model(ARM).n
    load, gain = np.zeros(n), np.ones(n)
    load[1], gain[3] = 0.08, 1.1
    coulomb, viscous = random.uniform(0.3, 2.0, (2, n))
    for name, seed, length in (("train", 1, seconds), ("other", 2, 0.5 * seconds)):
        wrong = Wrong(coulomb=coulomb, viscous=viscous, payload=2.0, load=load, gain=gain)
        made = record(load_model(ARM).mujoco_model, wrong, seed, seconds=length, rate=RATE)
        assert made.motor_torque is not None
        noise = NOISE_NM * np.random.default_rng(seed).normal(size=made.position.shape)
        save_recording(replace(made, torque_command=made.motor_torque + noise), folder / f"{name}.csv")


def main() -> int:
    """Make the recordings, diagnose them in a process of its own, print its time and memory."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=120.0)
    seconds = parser.parse_args().seconds
    with TemporaryDirectory() as scratch:
        make(Path(scratch), seconds)
        files = {
            "train": "train.csv",
            "heldout": "other.csv",
            "report": "a.html",
            "json": "a.json",
            "out-model": "a.xml",
        }
        options = [f"--{name}={file}" for name, file in files.items()]
        options += [f"--zero=q_{j + 1}=0" for j in range(load_model(ARM).n)]  # the motion leaves the model's ranges
        command = [str(Path(sys.executable).with_name("armlink")), "gap", "diagnose", f"--sim={ARM}", *options]
        subprocess.run(command, cwd=scratch, check=True, capture_output=True, env={**os.environ, **ONE_THREAD})
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{seconds:.0f} s: {used.ru_utime:.1f} s of one processor, {used.ru_maxrss / 1024:.0f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
