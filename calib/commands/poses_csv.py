"""Poses from a CSV file."""

from pathlib import Path

import numpy as np

from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from armlink.recording.csv_text import layout_of, read_numbers
from gcomp.arrays import Array


def load_poses(path: Path, n: int) -> Array:
    """Poses (K, n) [rad] from the columns q_1 … q_n of a CSV file with a header row; other columns are left alone.

    Raises BadInput naming the file and the column, or the row.
    """
    if not path.is_file():
        raise BadInput(f"there is no file {path}: give a CSV file with the columns q_1 … q_{n} [rad]")
    wanted = [f"q_{number}" for number in range(1, n + 1)]
    with memory_budget(path):
        content = path.read_bytes()
        layout = layout_of(content, str(path))
        missing = next((name for name in wanted if name not in layout.header), None)
        if missing is not None:
            raise BadInput(
                f"{path}: column {missing} is missing: expected one column for each joint, q_1 … q_{n} [rad]"
            )
        columns = {name: layout.header.index(name) for name in wanted}
        poses = np.column_stack(list(read_numbers(content, layout, columns, str(path)).values()))
    if not len(poses):
        raise BadInput(f"{path}: there is no pose below the header row")
    for row, joint in np.argwhere(~np.isfinite(poses)):
        raise BadInput(f"{path}: row {row + 1}: {wanted[joint]} is {poses[row, joint]}, expected an angle in rad")
    return poses
