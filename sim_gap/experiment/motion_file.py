"""Files of planned motion: CSV with columns t [s] and q_cmd_1 … q_cmd_n [rad], checked against the arm."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from armlink.arm_file import ArmFile
from armlink.content.atomic_file import open_whole
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from armlink.recording.tables import THREADS
from calib.arm.kinematics import gcomp_arm
from gcomp.arrays import Array
from sim_gap.experiment.excitation import Motion

ROUNDING = 1.05
"""Factor by which the speed between two rows may exceed max_velocity, for the rounding in a file."""


def save_motion(motion: Motion, path: Path) -> None:
    """Write `.csv`; raises BadInput if it cannot be written."""
    if path.suffix != ".csv":
        raise BadInput(f"{path}: a motion is written as .csv")
    columns = {"t": np.arange(len(motion.target)) / motion.rate}
    columns |= {f"q_cmd_{i + 1}": column for i, column in enumerate(motion.target.T)}
    try:
        with open_whole(path) as stream:
            pa_csv.write_csv(pa.table(columns), stream)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error}") from None


def load_motion(path: Path, arm: ArmFile) -> Array:
    """Targets (K, n) [rad], one per cycle of the arm's rate, from a CSV with columns t and q_cmd_i (others ignored).

    Raises BadInput if the motion does not fit the arm: columns, missing values, time, range, speed.
    """
    described, section = gcomp_arm(arm), arm.require_link()
    t, target = _columns(path, [f"q_cmd_{i + 1}" for i in range(described.n)])
    even: Array = np.arange(t[0], t[-1], 1.0 / section.rate)
    rows: Array = np.column_stack([np.interp(even, t, column) for column in target.T])
    for column, name, low, high, limits in zip(
        rows.T, described.names, described.lower, described.upper, section.joints, strict=True
    ):
        if column.min() < low or column.max() > high:
            raise BadInput(
                f"{path}: {name} goes from {column.min():.3f} to {column.max():.3f} rad, beyond its range {low:.3f} to "
                f"{high:.3f}: plan the motion for this arm: armlink gap plan {arm.argument} --out {path}"
            )
        fastest = float(np.abs(np.diff(column)).max()) * section.rate
        if fastest > ROUNDING * limits.max_velocity:
            raise BadInput(
                f"{path}: {name} turns at {fastest:.3f} rad/s, beyond its max_velocity {limits.max_velocity:.3f}: "
                f"plan the motion for this arm: armlink gap plan {arm.argument} --out {path}"
            )
    return rows


def _columns(path: Path, names: list[str]) -> tuple[Array, Array]:
    """Times (K,) and columns (K, n), all finite, times increasing."""
    try:
        with memory_budget(path):
            table = pa_csv.read_csv(path, pa_csv.ReadOptions(use_threads=THREADS))
    except (pa.ArrowInvalid, OSError) as error:
        raise BadInput(f"{path}: not a readable CSV file: {str(error).splitlines()[0]}") from None
    missing = [name for name in ("t", *names) if name not in table.column_names]
    if missing:
        raise BadInput(f"{path}: no column {', '.join(missing)}: expected t and q_cmd_1 to {names[-1]}")
    try:
        columns = [table.column(name).cast(pa.float64()).to_numpy() for name in ("t", *names)]
    except pa.ArrowInvalid as error:
        raise BadInput(f"{path}: {str(error).splitlines()[0]}: expected numbers") from None
    values = np.column_stack(columns)
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        raise BadInput(f"{path}: row {bad[0][0] + 1}: no value of {('t', *names)[bad[0][1]]}")
    t = values[:, 0]
    if len(t) < 2 or not (np.diff(t) > 0).all():
        raise BadInput(f"{path}: column t does not increase from row to row: expected seconds, at least two rows")
    return t, values[:, 1:]
