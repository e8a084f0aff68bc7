"""Tables of 3,000 poses each out of real recordings, where the machine has them."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from armlink.recording.files import load_recording

REAL_DATA = Path(os.environ.get("ARMLINK_REALDATA", Path(__file__).parents[3] / "shared" / "realdata"))
POSES = 3000
SETS = {
    "kinova_gen3": ("sim.urdf", "kinova_gen3", "joint_*_trapez.csv.gz", "motor_torque"),
    "ur10e": ("sim.xml", "ur10e", "*_?.csv.gz", "motor_torque"),
}
"""Name → model file, its folder, recordings, channel of torque."""


def real_poses(folder: Path) -> Iterator[tuple[str, Path, Path]]:
    """(Name, model, table) of each set; the slowest rows of the recordings count as poses."""
    for name, (model, place, pattern, channel) in SETS.items():
        files = sorted((REAL_DATA / place).glob(pattern))
        if not files:
            continue
        runs = [load_recording(path) for path in files]
        q, dq, tau = (
            np.concatenate([np.asarray(getattr(run, key)) for run in runs]) for key in ("position", "velocity", channel)
        )
        slowest = np.sort(np.argsort(np.abs(dq).max(axis=1), kind="stable")[:POSES])
        n = q.shape[1]
        header = ",".join(f"{key}_{i + 1}" for key in ("q", "tau_motor") for i in range(n))
        table = folder / f"{name}.csv"
        np.savetxt(table, np.hstack([q, tau])[slowest], delimiter=",", header=header, comments="")
        yield name, REAL_DATA / place / model, table
