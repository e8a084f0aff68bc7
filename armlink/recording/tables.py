"""Recordings as tables: CSV, gzipped CSV and Parquet, through pyarrow."""

import csv
import gzip
import json
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet

from armlink.arrays import Array
from armlink.errors import BadInput
from armlink.recording.column_names import suggested_map
from armlink.recording.recording import (
    Recording,
    channel_column,
    channels_of,
    columns_of,
    default_names,
    is_channel,
    joint_count,
)

_LOOK_BACK = 20_000  # bytes at the end of a CSV file that show how long its numbers are
NAMES_KEY = b"armlink.names"
"""Parquet schema metadata: joint names as JSON."""


def load_csv(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load `.csv` or `.csv.gz` with a header row (docs/formats.md), up to a truncation; raises BadInput.

    `columns`: column of docs/formats.md → the file's name for it.
    """
    content, cut = _content(path)
    header = _renamed(_header(path, content), columns, path)
    wanted = [column for column in header if is_channel(column)]
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(content),
            read_options=pa_csv.ReadOptions(column_names=header, skip_rows=1),
            convert_options=pa_csv.ConvertOptions(
                include_columns=wanted, column_types=dict.fromkeys(wanted, pa.float64())
            ),
        )
    except (pa.ArrowInvalid, OSError, EOFError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    loaded = _recording(table, header, str(path), ())
    if cut:
        cut = f"cut recording, {cut}: loaded {loaded.t.size} rows"
        loaded = replace(loaded, warning="; ".join(filter(None, (cut, loaded.warning))))
    return loaded


def load_parquet(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load Parquet with the columns of docs/formats.md, joint names from the schema's metadata; raises BadInput."""
    try:
        table = pa_parquet.read_table(path)
        header = _renamed(list(table.column_names), columns, path)
        table = table.rename_columns(header).replace_schema_metadata(table.schema.metadata)
        wanted = [column for column in header if is_channel(column)]
        metadata = table.schema.metadata or {}
        table = table.select(wanted).cast(pa.schema([(column, pa.float64()) for column in wanted]))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, OSError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    names = tuple(json.loads(metadata[NAMES_KEY])) if NAMES_KEY in metadata else ()
    return _recording(table, header, str(path), names)


def _renamed(header: list[str], columns: Mapping[str, str], path: Path) -> list[str]:
    """The header with the file's own names replaced; raises BadInput, with a `--map` to paste if channels lack."""
    foreign = {other: column for column, other in columns.items() if channel_column(other) is None}
    missing = [name for name in foreign if name not in header]
    if missing:
        raise BadInput(f"{path}: --map {foreign[missing[0]]}={missing[0]}: no such column; it has {', '.join(header)}")
    header = [foreign.get(name, name) for name in header]
    twins = sorted({column for column in header if header.count(column) > 1})
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} occurs twice in the header row or after --map")
    try:
        joint_count(header, str(path))
    except BadInput as error:
        suggestion = suggested_map(header) if not foreign else ""
        if not suggestion:
            raise
        raise BadInput(f"{error}; if its columns have other names, try {suggestion}") from None
    return header


def save_csv(recording: Recording, path: Path) -> None:
    """Write `.csv` or `.csv.gz` with all digits; NaN becomes an empty cell."""
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
    warning = f"columns ignored because they are no channels: {', '.join(ignored)}" if ignored else ""
    n = joint_count(header, source)
    if names and len(names) != n:
        raise BadInput(f"{source}: {len(names)} joint names for {n} joints")
    return Recording(t=columns["t"], names=names or default_names(n), warning=warning, **channels)  # type: ignore[arg-type]


def _numbers(column: Any) -> Array:
    values = column.to_numpy()
    return np.asarray(values, dtype=np.float64)


def _table(recording: Recording) -> Any:
    return pa.table({name: pa.array(values, from_pandas=True) for name, values in columns_of(recording).items()})


def _content(path: Path) -> tuple[bytes, str]:
    """Complete lines of the file, uncompressed, and why it is truncated (empty if it is not)."""
    try:
        content = path.read_bytes()
        cut = ""
        if path.name.lower().endswith(".gz"):
            content, ended = _unpacked(content)
            cut = "" if ended else "the file ends early"
    except (OSError, zlib.error) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    if content.endswith((b"\n", b"\r")) or not content:
        return content, cut
    whole = content.rfind(b"\n") + 1
    if not cut and _looks_whole(content):
        return content, ""
    return content[:whole], cut or "its last line is not complete"


def _unpacked(packed: bytes) -> tuple[bytes, bool]:
    """Content of the gzip members as far as it goes, and whether the last member is complete."""
    parts, ended = [], False
    while packed:
        member = zlib.decompressobj(wbits=31)
        parts.append(member.decompress(packed))
        ended, packed = member.eof, member.unused_data.lstrip(b"\0")
        if not ended:
            break
    return b"".join(parts), ended


def _looks_whole(content: bytes) -> bool:
    """Whether a last line without newline is complete: all columns, its last number as long as any above it.

    A truncated number has fewer decimals than the others of its column, or is shorter.
    """
    lines = content[-_LOOK_BACK:].decode("utf-8", "replace").splitlines()
    *before, last = (line.split(",") for line in lines)
    if len(content) > _LOOK_BACK:
        before = before[1:]
    before = [cells for cells in before if len(cells) == len(last)]
    rest = [cells[-1] for cells in before if _is_number(cells[-1])]
    if not before or len(last) < 2 or not (_is_number(last[-1]) or not rest):
        return False
    digits = [len(cell.partition(".")[2]) for cell in (*rest, last[-1])]
    if any(digits):
        return digits[-1] >= max(digits[:-1], default=0)
    return len(last[-1]) >= max(map(len, rest), default=0)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _header(path: Path, content: bytes) -> list[str]:
    try:
        line = content.partition(b"\n")[0].decode("utf-8-sig")
        header = [column.strip() for column in next(csv.reader([line]), [])]
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    twins = sorted({column for column in header if header.count(column) > 1})
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} occurs twice in the header row")
    return header


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
