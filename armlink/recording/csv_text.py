"""How a CSV file is written: separator, decimal sign, lines of comment, and the header row."""

import csv
import re
from dataclasses import dataclass

from armlink.errors import BadInput

SEPARATORS = ",;\t "
"""Those that are looked for, the first of those that occur as often; spaces only where there is no other."""


@dataclass(frozen=True)
class CsvLayout:
    """How the text is to be read."""

    header: tuple[str, ...]
    lines: int
    """Lines up to the header row, which is the last of them."""
    separator: str = ","
    decimal: str = "."
    first: tuple[str, ...] = ()
    """Cells of the first row of values."""

    def first_value(self, column: int) -> str:
        """Cell of the first row of values in a column; empty where there is none."""
        return self.first[column] if column < len(self.first) else ""


def layout_of(content: bytes | bytearray, source: str) -> CsvLayout:
    """Layout of a file's content, of which the first lines are looked at. Raises BadInput where it has no header row.

    Lines of comment (`#`) may stand above the header row, or the last of them is it.
    """
    try:
        lines = [line.decode("utf-8-sig") for line in content[: 1 << 18].split(b"\n")]
    except UnicodeDecodeError as error:
        raise BadInput(f"{source}: not a readable CSV file: {error}") from None
    above = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    if above and above < len(lines) and _is_values(lines[above]):
        above -= 1
    text = lines[above] if above < len(lines) else ""
    if _is_values(text):
        raise BadInput(f"{source}: its first row holds numbers, expected a header row with the names of the columns")
    text = text.lstrip("# ") if text.startswith("#") else text
    separator = _separator(text)
    following = lines[above + 1] if above + 1 < len(lines) else ""
    comma = separator != "," and re.search(r"\d,\d", following) is not None
    return CsvLayout(
        tuple(_cells(text, separator, source)),
        above + 1,
        separator,
        "," if comma else ".",
        tuple(_cells(following, separator, source)),
    )


def _separator(header: str) -> str:
    """The separator of a header row, of which quoted parts do not count."""
    plain = re.sub(r'"[^"]*"', "", header.strip())
    most = max(SEPARATORS[:-1], key=plain.count)
    return most if most in plain or " " not in plain else " "


def _cells(line: str, separator: str, source: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as error:
        raise BadInput(f"{source}: not a readable CSV file: {error}") from None


def _is_values(line: str) -> bool:
    """Whether a line holds numbers in all of its cells but one, in which may stand a date."""
    cells = [cell for cell in _plain_cells(line) if cell]
    numbers = sum(is_number(cell) for cell in cells)
    return numbers > 0 and numbers >= len(cells) - 1


def _plain_cells(line: str) -> list[str]:
    separator = _separator(line)
    comma = separator != ","
    return [cell.strip().replace(",", ".") if comma else cell.strip() for cell in line.split(separator)]


def is_number(cell: str) -> bool:
    """Whether a cell holds a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
