"""Recordings as tables: CSV, gzipped CSV and Parquet, through pyarrow."""

import csv
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet

from armlink.errors import BadInput
from armlink.recording import Array, Recording, channels_of, columns_of, default_names, is_channel, joint_count

NAMES_KEY = b"armlink.names"
"""Parquet schema metadata: joint names as JSON."""


def load_csv(path: Path) -> Recording:
    """Load `.csv` or `.csv.gz` with a header row of contract 2's names; raises BadInput."""
    header = _header(path)
    joint_count(header, str(path))
    wanted = [column for column in header if is_channel(column)]
    try:
        table = pa_csv.read_csv(
            path,
            read_options=pa_csv.ReadOptions(column_names=header, skip_rows=1),
            convert_options=pa_csv.ConvertOptions(
                include_columns=wanted, column_types=dict.fromkeys(wanted, pa.float64())
            ),
        )
    except (pa.ArrowInvalid, OSError, EOFError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    return _recording(table, header, str(path), ())


def load_parquet(path: Path) -> Recording:
    """Load Parquet with contract 2's column names; joint names from the schema's metadata; raises BadInput."""
    try:
        table = pa_parquet.read_table(path)
        header = list(table.column_names)
        wanted = [column for column in header if is_channel(column)]
        metadata = table.schema.metadata or {}
        table = table.select(wanted).cast(pa.schema([(column, pa.float64()) for column in wanted]))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, OSError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    names = tuple(json.loads(metadata[NAMES_KEY])) if NAMES_KEY in metadata else ()
    return _recording(table, header, str(path), names)


def save_csv(recording: Recording, path: Path) -> None:
    """Write `.csv` or `.csv.gz`, numbers with all their digits, NaN as an empty cell."""
    table = _table(recording)
    options = pa_csv.WriteOptions(include_header=False, quoting_style="none")
    packed = path.name.lower().endswith(".gz")
    with gzip.open(path, "wb", compresslevel=6) if packed else open(path, "wb") as stream:
        stream.write(f"{','.join(table.column_names)}\n".encode())
        pa_csv.write_csv(table, stream, options)


def save_parquet(recording: Recording, path: Path) -> None:
    """Write Parquet with the joint names in the schema's metadata."""
    names = {NAMES_KEY: json.dumps(recording.names).encode()}
    pa_parquet.write_table(_table(recording).replace_schema_metadata(names), path, compression="zstd")


def _recording(table: Any, header: list[str], source: str, names: tuple[str, ...]) -> Recording:
    columns = {column: _numbers(table.column(column)) for column in table.column_names}
    channels = channels_of(columns, source)
    ignored = [column for column in header if not is_channel(column)]
    warning = f"columns that are not channels left out: {', '.join(ignored)}" if ignored else ""
    n = joint_count(header, source)
    if names and len(names) != n:
        raise BadInput(f"{source}: {len(names)} joint names for {n} joints")
    return Recording(t=columns["t"], names=names or default_names(n), warning=warning, **channels)  # type: ignore[arg-type]


def _numbers(column: Any) -> Array:
    values = column.to_numpy()
    return np.asarray(values, dtype=np.float64)


def _table(recording: Recording) -> Any:
    return pa.table({name: pa.array(values, from_pandas=True) for name, values in columns_of(recording).items()})


def _header(path: Path) -> list[str]:
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opener(path, "rt", encoding="utf-8-sig", newline="") as stream:
            header = [column.strip() for column in next(csv.reader([stream.readline()]), [])]
    except (OSError, UnicodeDecodeError, EOFError) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    twins = sorted({column for column in header if header.count(column) > 1})
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} stands twice in the header row")
    return header


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
