"""Tables on narrow terminals: cells wrap between words, and where that is too wide each row becomes a list.

Names of joints and effects are never cut: rich alone cuts a word that is wider than its column.
"""

import copy
from dataclasses import replace

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table

UNBOUNDED = 100_000
"""Columns of a terminal on which everything fits."""


def fitted(table: Table, console: Console, options: ConsoleOptions) -> RenderableType:
    """The table as it is where it fits, with wrapped cells where whole words fit, else a list of headings and values.

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
        return Group(title, fitted(table, console, options))
    fitting = _in_width(table, console, options)
    return _listed(table, console, options) if fitting is None else fitting


def _in_width(table: Table, console: Console, options: ConsoleOptions) -> Table | None:
    """The table in this width, its cells wrapped between words if need be; None where a word would be cut."""
    wide = options.update(width=UNBOUNDED)
    width = Measurement.get(console, wide, table).maximum
    if width <= options.max_width:
        return table
    columns = [_width_of_column(console, wide, table, number) for number in range(len(table.columns))]
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


def _width_of_column(console: Console, wide: ConsoleOptions, table: Table, number: int) -> Measurement:
    """The longest word and the longest line of a column, its heading included."""
    column = table.columns[number]
    cells = [Measurement.get(console, wide, cell) for cell in (column.header, *column.cells)]
    widest = max(cell.maximum for cell in cells)
    return Measurement(widest if column.no_wrap else max(cell.minimum for cell in cells), widest)


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
