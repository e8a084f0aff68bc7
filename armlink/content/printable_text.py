"""Text from outside (files, models, devices) as it is shown: nothing in it can act on a terminal, a line or a file.

Terminals obey control characters (ESC, C1), editors and pages obey bidirectional controls, and every text format ends
a line or a comment at a line break. Python's `str.isprintable` tells all of them from letters (Unicode categories Cc,
Cf, Cs, Co, Cn, Zl, Zp, and spaces other than U+0020).
"""

import json
import logging
import unicodedata
from typing import Any


def printable_text(text: str, keep: str = "") -> str:
    """The text on one line, with every character that is not printable as its escape, such as `\\x1b`.

    Spaces of any width stay, and the characters in `keep`.
    """
    if text.isprintable():
        return text
    escaped = (each if _is_harmless(each) or each in keep else each.encode("unicode_escape").decode() for each in text)
    return "".join(escaped)


def printable_json(value: Any, **options: Any) -> str:
    """`json.dumps` with letters as they are, and escapes of JSON for what is not printable."""
    text = json.dumps(value, ensure_ascii=False, **options)
    if text.isprintable():
        return text
    return "".join(each if _is_harmless(each) or each == "\n" else json.dumps(each)[1:-1] for each in text)


class PrintableFormatter(logging.Formatter):
    """Lines of a log that go to a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """As logging has it; lines of a traceback stay lines."""
        return printable_text(super().format(record), keep="\n" if record.exc_info else "")


def _is_harmless(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"
