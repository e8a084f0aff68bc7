"""Recordings as tables: CSV, gzipped CSV and Parquet, through pyarrow."""

import gzip
import json
import math
import zlib
from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pa_compute
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet

from armlink.arrays import Array
from armlink.content.atomic_file import open_whole
from armlink.errors import BadInput
from armlink.recording.column_names import joint_names, suggested_map
from armlink.recording.csv_text import CsvLayout, is_number, layout_of
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
THREADS = False
"""Arrow's threads may abort a process that ends right after it has read (arrow issue 34314); 120 MB are read as fast
without them."""


def load_csv(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Recording:
    """Load `.csv` or `.csv.gz` with a header row (docs/formats.md), up to a truncation; raises BadInput.

    `columns`: column of docs/formats.md → the file's name for it.
    """
    _require_header(path)
    content, cut, layout = _content(path)
    _require_each_once(layout.header, path)
    require_width(layout.header, str(path))
    header = _renamed(list(layout.header), columns, path)
    wanted = [column for column in header if is_channel(column)]
    require_size(8 * len(wanted) * content.count(b"\n"), str(path))
    kinds = dict.fromkeys(wanted, pa.float64())
    first = layout.first_value(header.index("t")).replace(layout.decimal, ".") if "t" in kinds else ""
    if first and not is_number(first):
        del kinds["t"]  # dates: for Arrow to recognise
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(content),
            read_options=pa_csv.ReadOptions(
                column_names=_unnamed_apart(header), skip_rows=layout.lines, use_threads=THREADS
            ),
            parse_options=pa_csv.ParseOptions(delimiter=layout.separator),
            convert_options=pa_csv.ConvertOptions(
                include_columns=wanted, column_types=kinds, decimal_point=layout.decimal
            ),
        )
    except (pa.ArrowInvalid, OSError, EOFError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    loaded = _recording(table, header, str(path), _names_of_columns(columns, header))
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
            require_size(8 * file.metadata.num_columns * file.metadata.num_rows, str(path))
            _require_each_once(schema.names, path, "")
            apart = columns_of_lists(file, str(path))
            header = _renamed(list(apart), columns, path)
            wanted = {column: apart[name] for column, name in zip(header, apart, strict=True) if is_channel(column)}
            require_numbers(file, {name for name, _ in wanted.values()}, str(path))
            table = file.read(columns=sorted({name for name, _ in wanted.values()}), use_threads=THREADS)
        taken = {
            column: table[name] if k is None else pa_compute.list_element(table[name], k)
            for column, (name, k) in wanted.items()
        }
        made = pa.table({c: x if pa.types.is_timestamp(x.type) else x.cast(pa.float64()) for c, x in taken.items()})
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: {_first_line(error)}") from None
    names = _names((schema.metadata or {}).get(NAMES_KEY), str(path)) or _names_of_columns(columns, header)
    return _recording(made, header, str(path), names)


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


def _names_of_columns(columns: Mapping[str, str], header: Sequence[str]) -> tuple[str, ...]:
    """Joint names that the file's own names of its position columns hold; empty where they hold none."""
    return joint_names([columns.get(f"q_{i}", "") for i in range(1, 1 + sum(_is_position(c) for c in header))])


def _is_position(column: str) -> bool:
    return (channel_column(column) or ("", 0))[0] == "q"


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
    with open_whole(path) as file, _gzipped(file) if packed else nullcontext(file) as stream:
        stream.write(f"{','.join(table.column_names)}\n".encode())
        pa_csv.write_csv(table, stream, options)


def save_parquet(recording: Recording, path: Path) -> None:
    """Write Parquet with the joint names in the schema's metadata."""
    names = {NAMES_KEY: json.dumps(recording.names).encode()}
    with open_whole(path) as stream:
        pa_parquet.write_table(_table(recording).replace_schema_metadata(names), stream, compression="zstd")


def _gzipped(stream: IO[bytes]) -> gzip.GzipFile:
    return gzip.GzipFile("", "wb", compresslevel=6, fileobj=stream)


def _recording(table: Any, header: list[str], source: str, names: tuple[str, ...]) -> Recording:
    columns = {
        column: (_seconds(table.column(column), source) if column == "t" else numbers(table.column(column)))
        for column in table.column_names
    }
    channels = channels_of(columns, source)
    ignored = [column for column in header if column and not is_channel(column)]
    warning = f"columns ignored because they are no channels: {', '.join(ignored)}" if ignored else ""
    n = joint_count(header, source)
    if names and len(names) != n:
        raise BadInput(f"{source}: {len(names)} joint names for {n} joints")
    return Recording(t=columns["t"], names=names or default_names(n), warning=warning, **channels)  # type: ignore[arg-type]


def _seconds(column: Any, source: str) -> Array:
    """Times in seconds: numbers as they are, dates from the first."""
    if pa.types.is_float64(column.type):
        return numbers(column)
    if not pa.types.is_timestamp(column.type):
        first = column[0].as_py() if len(column) else ""
        raise BadInput(
            f"{source}: row 1: t is {first!r}, expected a number [s] or a date such as 2026-11-24 12:00:00.25"
        )
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


def _content(path: Path) -> tuple[bytearray, str, CsvLayout]:
    """Complete lines of the file, uncompressed, why it is truncated (empty if it is not), and how it is written."""
    try:
        require_size(path.stat().st_size, str(path))
        packed, cut = path.read_bytes(), ""
        if path.name.lower().endswith(".gz"):
            content, ended = _unpacked(packed, str(path))
            cut = "" if ended else "the file ends early"
        else:
            content = bytearray(packed)
        del packed
    except (OSError, zlib.error) as error:
        raise BadInput(f"{path}: not a readable CSV file: {_first_line(error)}") from None
    layout = layout_of(content, str(path))
    if content.endswith((b"\n", b"\r")) or not content:
        return content, cut, layout
    whole = content.rfind(b"\n") + 1
    if not cut and _looks_whole(content, layout):
        return content, "", layout
    del content[whole:]
    return content, cut or "its last line is not complete", layout


def _unpacked(packed: bytes, source: str) -> tuple[bytearray, bool]:
    """Content of the gzip members as far as it goes, and whether the last member is complete; raises BadInput."""
    content, ended, whole = bytearray(), False, len(packed)
    while packed:
        member = zlib.decompressobj(wbits=31)
        while packed and not member.eof:
            content += member.decompress(packed, _PIECE)
            packed = member.unconsumed_tail
            require_size(len(content), source)
            if len(content) > _SURELY_MUCH and len(content) > _MOST_RATIO * whole:
                raise BadInput(f"{source}: unpacks to more than {_MOST_RATIO} times its size: not a recording")
        ended, packed = member.eof, member.unused_data.lstrip(b"\0")
        if not ended:
            break
    return content, ended


def _looks_whole(content: bytearray, layout: CsvLayout) -> bool:
    """Whether a last line without newline is complete: all columns, its last number as long as any above it.

    A truncated number has fewer decimals than the others of its column, or is shorter.
    """
    lines = content[-_LOOK_BACK:].decode("utf-8", "replace").splitlines()
    *before, last = (line.replace(layout.decimal, ".").split(layout.separator) for line in lines)
    if len(content) > _LOOK_BACK:
        before = before[1:]
    before = [cells for cells in before if len(cells) == len(last)]
    rest = [cells[-1] for cells in before if is_number(cells[-1])]
    if not before or len(last) < 2 or not (is_number(last[-1]) or not rest):
        return False
    digits = [len(cell.partition(".")[2]) for cell in (*rest, last[-1])]
    if any(digits):
        return digits[-1] >= max(digits[:-1], default=0)
    return len(last[-1]) >= max(map(len, rest), default=0)


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


def _require_each_once(header: Sequence[str], path: Path, where: str = " in the header row") -> None:
    twins = sorted(column for column in set(header) if column and header.count(column) > 1)
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} occurs twice{where}")


def _unnamed_apart(header: Sequence[str]) -> list[str]:
    """The header with a name each for columns that have none."""
    return [column or f"column {k + 1} without a name" for k, column in enumerate(header)]


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
