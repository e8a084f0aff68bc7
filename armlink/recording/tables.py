"""Recordings as tables: CSV and gzipped CSV, and how columns of any table become channels."""

import gzip
import zlib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from armlink.arrays import Array
from armlink.content.atomic_file import open_whole
from armlink.errors import BadInput
from armlink.recording.column_names import joint_names, suggested_map
from armlink.recording.csv_text import CsvLayout, is_number, layout_of, read_numbers, write_numbers
from armlink.recording.recording import (
    PIECE_BYTES,
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
_MOST_HEADER = 1 << 18
_MOST_RATIO, _SURELY_MUCH = 200, 1 << 28
"""A file that unpacks to more than _SURELY_MUCH bytes must not be smaller than this share of them."""


def load_csv(
    path: Path,
    columns: Mapping[str, str] = MappingProxyType({}),
    stated: tuple[str, ...] = (),
    poses: bool = False,
) -> Recording:
    """Load `.csv` or `.csv.gz` with a header row (docs/formats.md), up to a truncation; raises BadInput.

    `columns`: column of docs/formats.md → the file's name for it. `stated`: names of the columns of a file without a
    header row; empty for one to leave out. `poses`: a table without times is one of poses, numbered by the second.
    """
    _require_header(path)
    content, cut, layout = _content(path, stated)
    require_each_once(layout.header, path)
    require_width(layout.header, str(path))
    timeless = poses and not {"t", columns.get("t", "t")} & set(layout.header)
    header = renamed_header([*layout.header, *["t"] * timeless], columns, path)[: len(layout.header)]
    wanted = [column for column in header if is_channel(column)]
    require_size(8 * len(wanted) * content.count(b"\n"), str(path))
    places = {column: header.index(column) for column in wanted}
    arrays = read_numbers(content, layout, places, str(path))
    if timeless:
        header, arrays = [*header, "t"], {**arrays, "t": np.arange(len(next(iter(arrays.values()))), dtype=float)}
    loaded = recording_of_columns(arrays, header, str(path), names_of_columns(columns, header))
    if cut:
        cut = f"truncated recording ({cut}): the first {loaded.t.size} rows were loaded"
        loaded = replace(loaded, warning="; ".join(filter(None, (cut, loaded.warning))))
    return loaded


def names_of_columns(columns: Mapping[str, str], header: Sequence[str]) -> tuple[str, ...]:
    """Joint names that the file's own names of its position columns hold; empty where they hold none."""
    positions = sum((channel_column(column) or ("", 0))[0] == "q" for column in header)
    return joint_names([columns.get(f"q_{i}", "") for i in range(1, 1 + positions)])


def renamed_header(header: list[str], columns: Mapping[str, str], path: Path) -> list[str]:
    """The header with the file's own names replaced; raises BadInput, with a `--map` to paste if channels lack."""
    foreign = {other: column for column, other in columns.items() if channel_column(other) is None}
    missing = [name for name in foreign if name not in header]
    if missing:
        raise BadInput(
            f"{path}: --map {foreign[missing[0]]}={missing[0]}: the file has no column {missing[0]}; it has "
            f"{', '.join(header)}"
        )
    header = [foreign.get(name, name) for name in header]
    twins = sorted({column for column in header if column and header.count(column) > 1})
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
    packed = path.name.lower().endswith(".gz")
    with open_whole(path) as file, gzip.GzipFile("", "wb", 6, file) if packed else nullcontext(file) as stream:
        write_numbers(stream, columns_of(recording))


def recording_of_columns(
    columns: Mapping[str, Array], header: list[str], source: str, names: tuple[str, ...]
) -> Recording:
    """The recording that a table's columns hold; raises BadInput where some are missing."""
    channels = channels_of(columns, source)
    ignored = [column for column in header if column and not is_channel(column)]
    warning = f"columns that are no channels are ignored: {', '.join(ignored)}" if ignored else ""
    n = joint_count(header, source)
    if names and len(names) != n:
        raise BadInput(f"{source}: `armlink.names` has {len(names)} names for {n} joints: give one for each joint")
    return Recording(t=columns["t"], names=names or default_names(n), warning=warning, **channels)  # type: ignore[arg-type]


def _content(path: Path, stated: tuple[str, ...]) -> tuple[bytearray, str, CsvLayout]:
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
        first_line = str(error).partition("\n")[0]
        raise BadInput(f"{path}: not a readable CSV file: {first_line}") from None
    layout = layout_of(content, str(path), stated)
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
            content += member.decompress(packed, PIECE_BYTES)
            packed = member.unconsumed_tail
            require_size(len(content), source)
            if len(content) > _SURELY_MUCH and len(content) > _MOST_RATIO * whole:
                raise BadInput(f"{source}: unpacks to more than {_MOST_RATIO} times its size, so it is not a recording")
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


def require_each_once(header: Sequence[str], path: Path, where: str = " in the header row") -> None:
    """Raise BadInput where a column's name occurs twice."""
    twins = sorted(column for column in set(header) if column and header.count(column) > 1)
    if twins:
        raise BadInput(f"{path}: column {twins[0]!r} occurs twice{where}")
