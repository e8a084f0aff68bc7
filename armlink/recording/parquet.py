"""Recordings as Parquet, through pyarrow: columns of numbers, or of lists with one number a joint."""

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pa_compute
import pyarrow.parquet as pa_parquet

from armlink.arrays import Array
from armlink.content.atomic_file import open_whole
from armlink.errors import BadInput
from armlink.recording.csv_text import time_error
from armlink.recording.recording import Recording, columns_of, is_channel, require_size, require_width
from armlink.recording.tables import names_of_columns, recording_of_columns, renamed_header, require_each_once

NAMES_KEY = b"armlink.names"
"""Parquet schema metadata: joint names as JSON."""
THREADS = False
"""Arrow's threads may abort a process that ends right after it has read (arrow issue 34314); 120 MB are read as fast
without them."""


def load_parquet(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load Parquet with the columns of docs/formats.md, joint names from the schema's metadata; raises BadInput."""
    try:
        with pa_parquet.ParquetFile(path) as file:  # `read_table` looks through data sets, and imports pandas
            schema = file.schema_arrow
            require_width(schema.names, str(path))
            require_size(8 * file.metadata.num_columns * file.metadata.num_rows, str(path))
            require_each_once(schema.names, path, "")
            apart = columns_of_lists(file, str(path))
            header = renamed_header(list(apart), columns, path)
            wanted = {column: apart[name] for column, name in zip(header, apart, strict=True) if is_channel(column)}
            require_numbers(file, {name for name, _ in wanted.values()}, str(path))
            table = file.read(columns=sorted({name for name, _ in wanted.values()}), use_threads=THREADS)
        taken = {
            column: table[name] if k is None else pa_compute.list_element(table[name], k)
            for column, (name, k) in wanted.items()
        }
        made = pa.table({c: x if pa.types.is_timestamp(x.type) else x.cast(pa.float64()) for c, x in taken.items()})
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: {str(error).partition(chr(10))[0]}") from None
    names = _names((schema.metadata or {}).get(NAMES_KEY), str(path)) or names_of_columns(columns, header)
    arrays = {
        column: _seconds(made[column], str(path)) if column == "t" else numbers(made[column])
        for column in made.column_names
    }
    return recording_of_columns(arrays, header, str(path), names)


def save_parquet(recording: Recording, path: Path) -> None:
    """Write Parquet with the joint names in the schema's metadata."""
    names = {NAMES_KEY: json.dumps(recording.names).encode()}
    with open_whole(path) as stream:
        pa_parquet.write_table(_table(recording).replace_schema_metadata(names), stream, compression="zstd")


def require_numbers(file: Any, columns: Collection[str], source: str) -> None:
    """Raise BadInput where columns of a Parquet file hold texts, or with their lists more than a recording may.

    A text that a dictionary repeats has any size; a number has at most eight bytes.
    """
    count = 0
    for group in range(file.metadata.num_row_groups):
        row_group = file.metadata.row_group(group)
        for place in range(row_group.num_columns):
            chunk = row_group.column(place)
            column = chunk.path_in_schema.partition(".")[0]
            if column not in columns:
                continue
            if chunk.physical_type == "BYTE_ARRAY":
                raise BadInput(f"{source}: column {column} holds texts, expected numbers")
            count += chunk.num_values
    require_size(8 * count, source)


def has_lists(kind: pa.DataType) -> bool:
    """Whether each value of a column of this type is a list."""
    return bool(pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind))


def columns_of_lists(file: Any, source: str) -> dict[str, tuple[str, int | None]]:
    """Name → column and place in it, of a Parquet file; a column of lists `q` counts as columns `q_1`, `q_2` …"""
    found: dict[str, tuple[str, int | None]] = {}
    for field in file.schema_arrow:
        if not has_lists(field.type):
            found[field.name] = field.name, None
            continue
        require_numbers(file, [field.name], source)
        first = next(file.iter_batches(1, columns=[field.name]), None)
        width = 0 if first is None or not len(first) else len(first.column(0)[0].as_py() or ())
        found |= {f"{field.name}_{k + 1}": (field.name, k) for k in range(width)}
    return found


def _names(content: bytes | None, source: str) -> tuple[str, ...]:
    """Joint names from the schema's metadata; empty where there are none, raises BadInput where they are none."""
    if content is None:
        return ()
    try:
        names = json.loads(content)
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadInput(f"{source}: the schema's metadata {NAMES_KEY.decode()} is no JSON list of joint names")
    return tuple(names)


def _seconds(column: Any, source: str) -> Array:
    """Times in seconds: numbers as they are, dates from the first."""
    if pa.types.is_float64(column.type):
        return numbers(column)
    if not pa.types.is_timestamp(column.type):
        raise time_error(column[0].as_py() if len(column) else "", 0, source)
    whole = column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64())
    ticks = np.concatenate([np.zeros(0, np.int64), *(chunk.to_numpy(zero_copy_only=False) for chunk in whole.chunks)])
    return np.asarray((ticks - ticks[:1]) * 1e-9, dtype=float)


def numbers(column: Any) -> Array:
    """Values of a chunked column of 64-bit numbers, NaN where it has none; Arrow's own conversions import pandas."""
    return np.concatenate([np.zeros(0), *(_of_chunk(chunk) for chunk in column.chunks if len(chunk))])


def _of_chunk(chunk: Any) -> Array:
    there, values = chunk.buffers()
    own = slice(chunk.offset, chunk.offset + len(chunk))
    found = np.frombuffer(values, np.float64)[own]
    if not chunk.null_count:
        return found
    known = np.unpackbits(np.frombuffer(there, np.uint8), bitorder="little")[own]
    return np.where(known, found, math.nan)


def _table(recording: Recording) -> Any:
    return pa.table({name: pa.array(values, from_pandas=True) for name, values in columns_of(recording).items()})
