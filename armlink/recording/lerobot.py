"""LeRobot data sets (format 2 and 3): one recording an episode, positions and position commands.

A data set is a folder with `meta/info.json` and Parquet files under `data/`; `observation.state` holds the positions
and `action` the commands, in degrees, radians, or a normalised range of the recorder's own calibration.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet

from armlink.arrays import Array
from armlink.errors import BadInput
from armlink.recording.recording import MOST_JOINTS, Recording, require_size
from armlink.recording.tables import THREADS

STATE, ACTION = "observation.state", "action"
_COLUMNS = ("episode_index", "timestamp", STATE, ACTION)


def load_lerobot(path: Path) -> dict[str, Recording]:
    """Recordings of all episodes by label (`FOLDER#EPISODE`). Raises BadInput that names what is missing."""
    names = _names(path)
    if len(names) > MOST_JOINTS:
        raise BadInput(f"{path}: {len(names)} joints in {STATE}, expected at most {MOST_JOINTS}")
    size, parts = 0, []
    for file in sorted((path / "data").rglob("*.parquet")):
        try:
            size += 8 * (2 * len(names) + 2) * pa_parquet.read_metadata(file).num_rows
            require_size(size, str(path))
            table = pa_parquet.read_table(file, columns=list(_COLUMNS), use_threads=THREADS)
        except (pa.ArrowException, KeyError, ValueError, OSError) as error:
            raise BadInput(f"{file}: not the data of a LeRobot data set: {str(error).partition(chr(10))[0]}") from None
        missing = [column for column in _COLUMNS if column not in table.column_names]
        if missing:
            raise BadInput(f"{file}: column {missing[0]} is missing: expected {', '.join(_COLUMNS)}")
        parts.append([_values(table[column], file, column, len(names)) for column in _COLUMNS])
    if not sum(len(part[0]) for part in parts):
        raise BadInput(f"{path}: no row in Parquet files under data/: download the data set with its data")
    episodes, times, state, action = (np.concatenate(column) for column in zip(*parts, strict=True))
    found = {}
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes == episode)
        rows = rows[np.argsort(times[rows], kind="stable")]
        found[f"{path}#{episode:.0f}"] = Recording(
            t=times[rows], position=state[rows], position_command=action[rows], names=names
        )
    return found


def _names(path: Path) -> tuple[str, ...]:
    """Joint names of the state, without the suffix `.pos`."""
    try:
        info = json.loads((path / "meta" / "info.json").read_text())
        names: Any = info["features"][STATE]["names"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise BadInput(f"{path}/meta/info.json: no names of {STATE} ({type(error).__name__} {error})") from None
    while isinstance(names, dict):
        names = next(iter(names.values()), [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadInput(f"{path}/meta/info.json: names of {STATE} are {names!r}: expected a list of joint names")
    return tuple(name.removesuffix(".pos") for name in names)


def _values(column: pa.ChunkedArray, file: Path, name: str, joints: int) -> Array:
    """The numbers of a column (K,), for state and action (K, joints)."""
    width = joints if name in (STATE, ACTION) else 0
    rows = column.to_pylist()
    if width and (wrong := {len(row) if isinstance(row, list) else 0 for row in rows} - {width}):
        raise BadInput(f"{file}: {name} has rows of {min(wrong)} values for {width} names: expected one a joint")
    try:
        values = np.asarray(rows, dtype=float).reshape(len(rows), *([width] if width else []))
    except (TypeError, ValueError):
        raise BadInput(f"{file}: {name} holds {column.type}: expected numbers") from None
    if name == "episode_index" and not (values == np.round(values)).all():
        raise BadInput(f"{file}: {name} is not a whole number in every row")
    return values
