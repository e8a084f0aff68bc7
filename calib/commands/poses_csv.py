"""Poses from a CSV file."""

import csv
from pathlib import Path

import numpy as np

from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from gcomp.arrays import Array


def load_poses(path: Path, n: int) -> Array:
    """Poses (K, n) [rad] from the columns q_1 … q_n of a CSV file with a header row; other columns are left alone.

    Raises BadInput naming the file and the column, or the line and what stands there.
    """
    if not path.is_file():
        raise BadInput(f"there is no file {path}: give a CSV file with the columns q_1 … q_{n} [rad]")
    try:
        with memory_budget(path), path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: not a CSV file: {error}") from None
    header = [name.strip() for name in rows[0]] if rows else []
    for column in range(1, n + 1):
        if f"q_{column}" not in header:
            raise BadInput(
                f"{path}: column q_{column} is missing: expected one column for each joint, q_1 … q_{n} [rad]"
            )
    if len(rows) < 2:
        raise BadInput(f"{path}: there is no pose below the header row")
    places = [header.index(f"q_{column}") for column in range(1, n + 1)]
    return np.array([[_number(path, line, row, place) for place in places] for line, row in enumerate(rows[1:], 2)])


def _number(path: Path, line: int, row: list[str], place: int) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise BadInput(f"{path}, row {line}, field {place + 1}: {text!r}, expected an angle in rad")
    return value
