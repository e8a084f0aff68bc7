"""Text from outside (files, models, devices) as it is shown: nothing in it can act on a terminal, a line or a file.

Terminals obey control characters (ESC, C1), editors and pages obey bidirectional controls, and every text format ends
a line or a comment at a line break. Python's `str.isprintable` tells all of them from letters (Unicode categories Cc,
Cf, Cs, Co, Cn, Zl, Zp, and spaces other than U+0020).
"""

import json
import logging
import re
import unicodedata
from typing import Any

_UNITS = re.compile(r" *(?:`[^`]*`|[^ ])+(?: +$)?| +$")
"""Parts of a line that are not broken, each with the spaces before it, the last also with those after it; a lone
backtick is a letter as any other."""


def printable_text(text: str, keep: str = "") -> str:
    """The text on one line, with every character that is not printable as its escape, such as `\\x1b`.

    Spaces of any width stay, and the characters in `keep`.
    """
    if text.isprintable():
        return text
    escaped = (each if _is_harmless(each) or each in keep else each.encode("unicode_escape").decode() for each in text)
    return "".join(escaped)


def wrap_text(text: str, width: int) -> str:
    """A line in lines of at most `width` columns, broken between words only: some spaces become line breaks.

    A command in backticks, a path and anything else without a space stays whole where a line cannot hold it.
    """
    lines = [""]
    for unit in _UNITS.findall(text):
        if unit.strip(" ") and lines != [""] and len(lines[-1]) + len(unit) > width:
            lines.append(unit[1:])
        else:
            lines[-1] += unit
    return "\n".join(lines)


def printable_json(value: Any, **options: Any) -> str:
    """`json.dumps` with letters as they are, and escapes of JSON for what is not printable."""
    text = json.dumps(value, ensure_ascii=False, **options)
    if text.isprintable():
        return text
    return "".join(each if _is_harmless(each) or each == "\n" else json.dumps(each)[1:-1] for each in text)


class PrintableFormatter(logging.Formatter):
    """Lines of a log that go to a terminal of so many columns; None: to something else."""

    def __init__(self, width: int | None = None) -> None:
        super().__init__()
        self._width = width

    def format(self, record: logging.LogRecord) -> str:
        """As logging has it; lines of a traceback stay lines."""
        if record.exc_info:
            return printable_text(super().format(record), keep="\n")
        text = printable_text(super().format(record))
        return text if self._width is None else wrap_text(text, self._width)


def _is_harmless(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"
