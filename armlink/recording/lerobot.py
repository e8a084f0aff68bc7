"""LeRobot data sets (format 2 and 3): one recording an episode, positions and position commands.

A data set is a folder with `meta/info.json` and Parquet files under `data/`; `observation.state` (or `state`) holds the
positions and `action` (or `actions`) the commands, in degrees, radians, or a normalised range of the recorder's own
calibration.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pa_compute
import pyarrow.parquet as pa_parquet

from armlink.arrays import Array
from armlink.content.atomic_file import open_whole
from armlink.content.file_content import MOST_TEXT, read_whole
from armlink.errors import BadInput
from armlink.recording.parquet import THREADS, has_lists, numbers, require_numbers
from armlink.recording.recording import MOST_JOINTS, Recording, default_names, require_size

STATES, ACTIONS = ("observation.state", "state"), ("action", "actions")
"""Names of the columns of positions and of commands, as recorders and converters write them."""
EFFORTS = ("observation.effort", "effort")
"""Names of the column of motor currents or torques, where a recorder writes one."""


def load_lerobot(path: Path, efforts: bool = False) -> dict[str, Recording]:
    """Recordings of all episodes by label (`FOLDER#EPISODE`), with `efforts` as motor torques if they are to be read.

    Raises BadInput that names what is missing.
    """
    features = _features(path)
    state, action = (next((name for name in known if name in features), known[0]) for known in (STATES, ACTIONS))
    effort = [name for name in EFFORTS if efforts and name in features][:1]
    names, columns = _names(path, features, state), ("episode_index", "timestamp", state, action, *effort)
    if len(names) > MOST_JOINTS:
        raise BadInput(f"{path}: {len(names)} joints in {state}, expected at most {MOST_JOINTS}")
    size, parts = 0, []
    for file in sorted((path / "data").rglob("*.parquet")):
        try:
            with pa_parquet.ParquetFile(file) as content:
                size += 8 * (len(columns[2:]) * len(names) + 2) * content.metadata.num_rows
                require_size(size, str(path))
                require_numbers(content, columns, str(file))
                table = content.read(columns=list(columns), use_threads=THREADS)
        except (pa.ArrowException, KeyError, ValueError, OSError) as error:
            raise BadInput(f"{file}: not the data of a LeRobot data set: {str(error).partition(chr(10))[0]}") from None
        missing = [column for column in columns if column not in table.column_names]
        if missing:
            raise BadInput(f"{file}: column {missing[0]} is missing: expected {', '.join(columns)}")
        parts.append(
            [_values(table[column], file, column, len(names) if column in columns[2:] else 0) for column in columns]
        )
    if not sum(len(part[0]) for part in parts):
        raise BadInput(f"{path}: the Parquet files under data/ have no rows: download the data set with these files")
    episodes, times, positions, commands, *torques = (np.concatenate(column) for column in zip(*parts, strict=True))
    found = {}
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes == episode)
        rows = rows[np.argsort(times[rows], kind="stable")]
        found[f"{path}#{episode:.0f}"] = Recording(
            t=times[rows],
            position=positions[rows],
            position_command=commands[rows],
            motor_torque=torques[0][rows] if torques else None,
            names=names,
        )
    return found


def save_observations(path: Path, episodes: Array, t: Array, observations: dict[str, Array]) -> None:
    """Write Parquet with the keys `observation.NAME`, values (K, m) of so many rows of a data set's episodes."""
    columns = {"episode_index": pa.array(episodes.astype(np.int64)), "timestamp": pa.array(t.astype(np.float32))}
    for name, values in observations.items():
        flat = pa.array(values.astype(np.float32).ravel())
        columns[f"observation.{name}"] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    with open_whole(path) as stream:
        pa_parquet.write_table(pa.table(columns), stream, compression="zstd")


def _features(path: Path) -> dict[str, Any]:
    try:
        features = json.loads(read_whole(path / "meta" / "info.json", MOST_TEXT))["features"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise BadInput(
            f"{path}/meta/info.json: cannot read the joint names of {STATES[0]} ({type(error).__name__} {error})"
        ) from None
    if not isinstance(features, dict) or not any(name in features for name in STATES):
        raise BadInput(f"{path}/meta/info.json: there are no joint names of {' or '.join(STATES)}")
    return features


def _names(path: Path, features: dict[str, Any], state: str) -> tuple[str, ...]:
    """Joint names of the state, without the suffix `.pos`; numbered where it has a width and no names."""
    described = features[state] if isinstance(features[state], dict) else {}
    given, shape = described.get("names"), described.get("shape")
    names = _flat(given)
    if not names and isinstance(shape, list) and len(shape) == 1 and isinstance(shape[0], int) and shape[0] > 0:
        return default_names(min(shape[0], MOST_JOINTS + 1))
    if not names or not all(isinstance(name, str) for name in names):
        raise BadInput(
            f"{path}/meta/info.json: names of {state} are {str(given)[:100]!r}: expected a list of joint names"
        )
    if len({*names}) < len(names):
        raise BadInput(f"{path}/meta/info.json: names of {state} occur twice: {str(given)[:100]!r}")
    return tuple(name.removesuffix(".pos") for name in names)


def _flat(names: Any) -> list[Any]:
    """Names in lists and groups, such as those of two arms, one after the other."""
    if isinstance(names, dict | list):
        return [each for part in (names.values() if isinstance(names, dict) else names) for each in _flat(part)]
    return [] if names is None else [names]


def _lengths(column: pa.ChunkedArray) -> Array:
    """Number of values in each row of a column of lists; 0 where a row has none or the column holds no lists."""
    if not has_lists(column.type):
        return np.zeros(len(column))
    return numbers(pa_compute.list_value_length(column).fill_null(0).cast(pa.float64()))


def _values(column: pa.ChunkedArray, file: Path, name: str, width: int) -> Array:
    """The numbers of a column (K,), for state and action (K, width)."""
    if width:
        lengths = _lengths(column)
        if (lengths != width).any():
            wrong = lengths[lengths != width].min()
            raise BadInput(
                f"{file}: {name} has rows of {wrong:.0f} values, but there are {width} names: expected one value "
                "for each joint"
            )
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks], column.type.value_type)
    try:
        values = numbers(column.cast(pa.float64())).reshape(-1, *([width] if width else []))
    except (pa.ArrowException, ValueError):
        raise BadInput(f"{file}: {name} holds {column.type}: expected numbers") from None
    if name == "episode_index" and not (values == np.round(values)).all():
        raise BadInput(f"{file}: {name} is not a whole number in every row")
    return values
