"""Tables on narrow terminals: headings wrap between words; else the table is cut between columns, its first in each
part; else cells wrap, too; and where that is too wide each row becomes a list.

Names of joints and effects are never cut: rich alone cuts a word that is wider than its column.
"""

import copy
from dataclasses import replace

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Column, Table

UNBOUNDED = 100_000
"""Columns of a terminal on which everything fits."""
MOST_PARTS = 3
"""A table in more parts is worse to read than one with wrapped cells."""


def fit_table(table: Table, console: Console, options: ConsoleOptions) -> RenderableType:
    """The table unchanged if it fits, otherwise the table with narrower columns.

    A title that is wider than the table becomes a line above it.
    """
    if not table.show_header:  # a layout, such as that of a progress bar
        return table
    wide = options.update(width=UNBOUNDED)
    title = table.title
    width = Measurement.get(console, wide, table).maximum
    if title is not None and Measurement.get(console, wide, title).maximum > min(width, options.max_width):
        table = copy.copy(table)
        table.title = None
        return Group(title, fit_table(table, console, options))
    whole = _in_width(table, console, options, whole_cells=True)
    if whole is not None:
        return whole
    if parts := _parts(table, console, options):
        return Group(*parts)
    wrapped = _in_width(table, console, options)
    return _listed(table, console, options) if wrapped is None else wrapped


def _parts(table: Table, console: Console, options: ConsoleOptions) -> list[Table]:
    """The table cut between columns, whole cells in each part; empty where the first column does not tell the rows
    apart, or it takes too many parts."""
    parts, rest = list[Table](), table.columns[1:]
    keys = {str(cell) for cell in table.columns[0].cells}
    if "" in keys or len(keys) < table.row_count:
        return []
    while rest:
        for count in range(len(rest), 0, -1):
            part = copy.copy(table)
            part.columns = [replace(each, _index=at) for at, each in enumerate((table.columns[0], *rest[:count]))]
            part.title = None if parts else table.title
            fitting = _in_width(part, console, options, whole_cells=True)
            if fitting is not None:
                break
        if fitting is None or len(parts) == MOST_PARTS:
            return []
        parts.append(fitting)
        rest = rest[count:]
    return parts


def _in_width(table: Table, console: Console, options: ConsoleOptions, *, whole_cells: bool = False) -> Table | None:
    """The table in this width, wrapped between words if need be, headings alone with `whole_cells`; None where a word
    would be cut."""
    wide = options.update(width=UNBOUNDED)
    width = Measurement.get(console, wide, table).maximum
    if width <= options.max_width:
        return table
    columns = [_width_of_column(console, wide, each, whole_cells) for each in table.columns]
    lacking = sum(each.maximum - each.minimum for each in columns)
    room = options.max_width - width + lacking
    if room < 0:
        return None
    shown = copy.copy(table)
    shown.columns = [
        replace(column, width=each.minimum + room * (each.maximum - each.minimum) // lacking, overflow="fold")
        for column, each in zip(table.columns, columns, strict=True)
    ]
    return shown


def _width_of_column(console: Console, wide: ConsoleOptions, column: Column, whole_cells: bool) -> Measurement:
    """The narrowest width of a column, and that of its longest line, its heading included."""
    heading, *cells = (Measurement.get(console, wide, cell) for cell in (column.header, *column.cells))
    widest = max(each.maximum for each in (heading, *cells))
    least = max([heading.minimum, *(each.maximum if whole_cells else each.minimum for each in cells)])
    return Measurement(widest if column.no_wrap else least, widest)


def _listed(table: Table, console: Console, options: ConsoleOptions) -> Group:
    """A block for each row: heading and value of each cell that is not empty, side by side or below each other."""
    title: list[RenderableType] = [] if table.title is None else [table.title]
    rows: list[RenderableType] = []
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        pairs = [(column.header, cell) for column, cell in zip(table.columns, cells, strict=True) if cell != ""]
        block = Table.grid(padding=(0, 2, 0, 0))
        block.add_column(overflow="fold", style="dim")
        block.add_column(overflow="fold")
        for pair in pairs:
            block.add_row(*pair)
        beside = _in_width(block, console, options)
        below = [Padding(part, (0, 0, 0, indent)) for pair in pairs for part, indent in zip(pair, (0, 2), strict=True)]
        rows += ["", *(below if beside is None else [beside])]
    return Group(*title, *rows[1:])
