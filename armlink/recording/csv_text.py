"""CSV as text: how a file is written (separator, decimal sign, lines of comment, header row), and its numbers."""

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from armlink.arrays import Array
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput

SEPARATORS = ",;\t "
"""Those that are looked for, the first of those that occur as often; spaces only where there is no other."""
NO_VALUE = frozenset(
    ("", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "1.#IND", "1.#QNAN", "N/A", "NA", "NULL", "n/a", "null")
)
"""Cells that hold no number, as spreadsheets, data frames and C write them; `nan` is a number to Python."""
DATE = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)(?:[T ](?P<hour>\d\d)(?::?(?P<minute>\d\d)(?::?(?P<second>\d\d(?:\.\d{1,9})?))?)?)?"
    r" ?(?:Z|(?P<zone>[+-]\d\d)(?::?(?P<zone_minute>\d\d))?)?"
)
"""A date of ISO 8601, with or without time of day and zone."""
WHOLE = re.compile(r"\.0(?=[,\n])")
"""End of a whole number, which is written without it."""
BLOCK_ROWS = 10_000
"""Rows that are turned into text at a time."""


@dataclass(frozen=True)
class CsvLayout:
    header: tuple[str, ...]
    lines: int
    """Lines up to the header row, which is the last of them."""
    separator: str = ","
    decimal: str = "."
    first: tuple[str, ...] = ()
    """Cells of the first row of values."""


def layout_of(content: bytes | bytearray, source: str, header: tuple[str, ...] = ()) -> CsvLayout:
    """Layout of a file's content, of which the first lines are looked at. Raises BadInput where it has no header row.

    Lines of comment (`#`) may stand above the header row, or the last of them is it. `header` are the columns of a file
    that has none.
    """
    try:
        lines = [line.decode("utf-8-sig") for line in content[: 1 << 18].split(b"\n")]
    except UnicodeDecodeError as error:
        raise BadInput(f"{source}: not a readable CSV file: {error}") from None
    above = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    if not header and above and above < len(lines) and _is_values(lines[above]):
        above -= 1
    text = lines[above] if above < len(lines) else ""
    if header and not _is_values(text):
        raise BadInput(
            f"{source}: its first row holds the names of the columns: leave `--columns` out, or rename columns "
            "with `--map`"
        )
    if not header and _is_values(text):
        raise BadInput(
            f"{source}: its first row holds numbers instead of the names of the columns: give the names with "
            "--columns t,q_1,…"
        )
    text = text.lstrip("# ") if text.startswith("#") else text
    separator = _separator(text)
    named, first = header, text
    if not header:
        named, above = tuple(_cells(text, separator, source)), above + 1
        first = lines[above] if above < len(lines) else ""
    cells = tuple(_cells(first, separator, source))
    if header and len(cells) != len(header):
        raise BadInput(f"{source}: --columns names {len(header)} columns, but the rows of the file have {len(cells)}")
    comma = separator != "," and re.search(r"\d,\d", first) is not None
    return CsvLayout(named, above, separator, "," if comma else ".", cells)


def _separator(header: str) -> str:
    """The separator of a header row, of which quoted parts do not count."""
    plain = re.sub(r'"[^"]*"', "", header.strip())
    most = max(SEPARATORS[:-1], key=plain.count)
    return most if most in plain or " " not in plain else " "


def _cells(line: str, separator: str, source: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as error:
        raise BadInput(f"{source}: its first rows cannot be read as CSV: {error}") from None


def _is_values(line: str) -> bool:
    """Whether a line holds numbers in all of its cells but one, in which may stand a date."""
    separator = _separator(line)
    plain = line if separator == "," else line.replace(",", ".")
    cells = [cell.strip() for cell in plain.split(separator) if cell.strip()]
    numbers = sum(is_number(cell) for cell in cells)
    return numbers > 0 and numbers >= len(cells) - 1


def is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_numbers(
    content: bytes | bytearray, layout: CsvLayout, columns: Mapping[str, int], source: str
) -> dict[str, Array]:
    """Columns by name, of their places in the header row, each (K,); NaN where a cell is empty.

    A time `t` may be dates, which become seconds from the first. Raises BadInput that names row and column.
    """
    first = [cell.replace(layout.decimal, ".") for cell in layout.first[columns["t"] :][:1]] if "t" in columns else []
    dates = any(cell not in NO_VALUE and not is_number(cell) for cell in first)
    if layout.first and content.count(b"\n") > layout.lines and not dates:
        try:
            return _read_at_once(content, layout, columns)
        except ValueError:
            pass  # an empty cell, or one that is to be named
    return _read_cell_by_cell(content, layout, columns, source, dates)


def _read_at_once(content: bytes | bytearray, layout: CsvLayout, columns: Mapping[str, int]) -> dict[str, Array]:
    """All cells by numpy's parser, in C; raises ValueError where one of them, or the length of a row, does not fit."""
    text = content.replace(b",", b".") if layout.decimal == "," else content
    kinds = [(f"{place}", "f8" if place in columns.values() else "S1") for place in range(len(layout.header))]
    rows = np.loadtxt(
        io.BytesIO(text),
        dtype=np.dtype(kinds),
        comments=None,
        delimiter=layout.separator,
        skiprows=layout.lines,
        quotechar='"',
        ndmin=1,
    )
    return {name: np.ascontiguousarray(rows[f"{place}"]) for name, place in columns.items()}


def _read_cell_by_cell(
    content: bytes | bytearray, layout: CsvLayout, columns: Mapping[str, int], source: str, dates: bool
) -> dict[str, Array]:
    lines = io.TextIOWrapper(io.BytesIO(content), "utf-8", errors="replace", newline="")
    for _ in range(layout.lines):
        lines.readline()
    found = np.full((content.count(b"\n") + 1, len(columns)), math.nan)
    time, began, row = (columns["t"] if dates else -1), None, 0
    try:
        for cells in csv.reader(lines, delimiter=layout.separator):
            if not cells:
                continue
            if len(cells) != len(layout.header):
                raise BadInput(f"{source}: row {row + 1}: expected {len(layout.header)} columns, got {len(cells)}")
            for k, (name, place) in enumerate(columns.items()):
                if place != time:
                    found[row, k] = _value(cells[place], layout.decimal, name, row, source)
                elif cells[place] not in NO_VALUE:
                    tick = _nanoseconds(cells[place], row, source)
                    began = tick if began is None else began
                    found[row, k] = (tick - began) * 1e-9
            row += 1
    except csv.Error as error:
        raise BadInput(f"{source}: row {row + 1}: not a readable row: {error}") from None
    return {name: found[:row, k].copy() for k, name in enumerate(columns)}


def _value(cell: str, decimal: str, name: str, row: int, source: str) -> float:
    text = cell.replace(",", ".") if decimal == "," else cell
    try:
        return float(text)
    except ValueError:
        if cell.strip() in NO_VALUE:
            return math.nan
    raise BadInput(f"{source}: row {row + 1}: {name}: invalid value {cell[:100]!r}, expected a number")


def _nanoseconds(cell: str, row: int, source: str) -> int:
    """Nanoseconds of a date since 1970; raises BadInput where it is none."""
    date = DATE.fullmatch(cell.strip())
    try:
        if date is None:
            raise ValueError
        clock = f"{date['hour'] or '00'}:{date['minute'] or '00'}:{date['second'] or '00'}"
        ticks = int(np.datetime64(f"{date['day']}T{clock}", "ns").astype(np.int64))
    except ValueError:
        raise time_error(cell, row, source) from None
    hours, minutes = int(date["zone"] or 0), int(date["zone_minute"] or 0)
    return ticks - (60 * hours + (-minutes if (date["zone"] or "").startswith("-") else minutes)) * 60_000_000_000


def time_error(cell: object, row: int, source: str) -> BadInput:
    """The refusal of a cell, in the row counted from 0, that is neither a number nor a date."""
    return BadInput(
        f"{source}: row {row + 1}: t is {cell!r}, expected a number [s] or a date such as 2026-11-24 12:00:00.25"
    )


def load_columns(path: Path, wanted: Sequence[str]) -> Array:
    """Columns of a CSV file with a header row, finite numbers alone (K, columns); other columns are left alone.

    Raises BadInput naming the file and the column, or the row.
    """
    if not path.is_file():
        raise BadInput(f"there is no file {path}: give a CSV file with the columns {', '.join(wanted)}")
    with memory_budget(path):
        content = path.read_bytes()
        layout = layout_of(content, str(path))
        missing = next((name for name in wanted if name not in layout.header), None)
        if missing is not None:
            raise BadInput(f"{path}: column {missing} is missing: expected the columns {', '.join(wanted)}")
        places = {name: layout.header.index(name) for name in wanted}
        values = np.column_stack(list(read_numbers(content, layout, places, str(path)).values()))
    if not len(values):
        raise BadInput(f"{path}: there is no row of values below the header row")
    for row, column in np.argwhere(~np.isfinite(values)):
        raise BadInput(f"{path}: row {row + 1}: {wanted[column]} is {values[row, column]}, expected a number")
    return values


def write_numbers(stream: IO[bytes] | io.BufferedIOBase, columns: Mapping[str, Array]) -> None:
    """Write columns (K,) with a header row and all digits; NaN becomes an empty cell."""
    rows = np.column_stack(list(columns.values()))
    stream.write(f"{','.join(columns)}\n".encode())
    for begin in range(0, len(rows), BLOCK_ROWS):
        block = rows[begin : begin + BLOCK_ROWS].tolist()
        text = "\n".join([",".join(map(repr, row)) for row in block])
        text = WHOLE.sub("", f"{text}\n".replace("nan", ""))
        stream.write(text.encode())
