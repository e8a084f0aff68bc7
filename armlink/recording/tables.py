"""Recordings as tables: CSV, gzipped CSV and Parquet, through pyarrow."""

import csv
import gzip
import json
import math
import zlib
from collections import Counter
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
    require_size,
    require_width,
)

_LOOK_BACK = 20_000  # bytes at the end of a CSV file that show how long its numbers are
_PIECE = 1 << 24  # bytes that are unpacked at a time
_MOST_HEADER = 1 << 18
_MOST_RATIO, _SURELY_MUCH = 200, 1 << 28
"""A file that unpacks to more than _SURELY_MUCH bytes must not be smaller than this share of them."""
NAMES_KEY = b"armlink.names"
"""Parquet schema metadata: joint names as JSON."""


def load_csv(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load `.csv` or `.csv.gz` with a header row (docs/formats.md), up to a truncation; raises BadInput.

    `columns`: column of docs/formats.md → the file's name for it.
    """
    _require_header(path)
    content, cut = _content(path)
    header = _header(path, content)
    require_width(header, str(path))
    header = _renamed(header, columns, path)
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
    del table, content
    pa.default_memory_pool().release_unused()
    if cut:
        cut = f"cut recording, {cut}: loaded {loaded.t.size} rows"
        loaded = replace(loaded, warning="; ".join(filter(None, (cut, loaded.warning))))
    return loaded


def load_parquet(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load Parquet with the columns of docs/formats.md, joint names from the schema's metadata; raises BadInput."""
    try:
        with pa_parquet.ParquetFile(path) as file:  # `read_table` looks through data sets, and imports pandas
            schema = file.schema_arrow
            require_width(schema.names, str(path))
            header = _renamed(list(schema.names), columns, path)
            wanted = {column: name for column, name in zip(header, schema.names, strict=True) if is_channel(column)}
            require_size(8 * len(wanted) * file.metadata.num_rows, str(path))
            table = file.read(columns=list(wanted.values())).select(list(wanted.values()))
        table = table.rename_columns(list(wanted)).cast(pa.schema([(column, pa.float64()) for column in wanted]))
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    return _recording(table, header, str(path), _names((schema.metadata or {}).get(NAMES_KEY), str(path)))


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
        suggestion = suggested_map([name for name in header if len(name) <= 100]) if not foreign else ""
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
    columns = {column: numbers(table.column(column)) for column in table.column_names}
    channels = channels_of(columns, source)
    ignored = [column for column in header if not is_channel(column)]
    warning = f"columns ignored because they are no channels: {', '.join(ignored)}" if ignored else ""
    n = joint_count(header, source)
    if names and len(names) != n:
        raise BadInput(f"{source}: {len(names)} joint names for {n} joints")
    return Recording(t=columns["t"], names=names or default_names(n), warning=warning, **channels)  # type: ignore[arg-type]


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


def _content(path: Path) -> tuple[bytes, str]:
    """Complete lines of the file, uncompressed, and why it is truncated (empty if it is not)."""
    try:
        require_size(path.stat().st_size, str(path))
        content = path.read_bytes()
        cut = ""
        if path.name.lower().endswith(".gz"):
            content, ended = _unpacked(content, str(path))
            cut = "" if ended else "the file ends early"
    except (OSError, zlib.error) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    if content.endswith((b"\n", b"\r")) or not content:
        return content, cut
    whole = content.rfind(b"\n") + 1
    if not cut and _looks_whole(content):
        return content, ""
    return content[:whole], cut or "its last line is not complete"


def _unpacked(packed: bytes, source: str) -> tuple[bytes, bool]:
    """Content of the gzip members as far as it goes, and whether the last member is complete; raises BadInput."""
    parts, ended, size, whole = [], False, 0, len(packed)
    while packed:
        member = zlib.decompressobj(wbits=31)
        while packed and not member.eof:
            parts.append(member.decompress(packed, _PIECE))
            packed = member.unconsumed_tail
            size += len(parts[-1])
            require_size(size, source)
            if size > _SURELY_MUCH and size > _MOST_RATIO * whole:
                raise BadInput(f"{source}: unpacks to more than {_MOST_RATIO} times its size: not a recording")
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


def _require_header(path: Path) -> None:
    """Raise BadInput where the header row is longer than any of a recording; reads no more than that."""
    packed = path.name.lower().endswith(".gz")
    try:
        with gzip.open(path, "rb") if packed else open(path, "rb") as stream:
            begin = stream.read(_MOST_HEADER)
    except (OSError, EOFError, zlib.error):
        return  # said by who reads it whole, as far as it goes
    if len(begin) == _MOST_HEADER and b"\n" not in begin:
        raise BadInput(f"{path}: its header row has more than {_MOST_HEADER // 1024} kB, expected names of columns")


def _header(path: Path, content: bytes) -> list[str]:
    try:
        line = content.partition(b"\n")[0].decode("utf-8-sig")
        header = [column.strip() for column in next(csv.reader([line]), [])]
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    twins = sorted(column for column, count in Counter(header).items() if count > 1)
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} occurs twice in the header row")
    return header


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
