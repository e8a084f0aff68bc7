"""Answers for machines: JSON to a file or standard output."""

import math
from pathlib import Path
from typing import Any

from armlink.content.atomic_file import write_whole
from armlink.content.printable_text import printable_json


def write_json(path: Path | None, answer: Any) -> None:
    """Write `answer` as JSON to `path` (`-`: standard output, None: nowhere); what is not finite becomes null."""
    if path is None:
        return
    text = printable_json(_finite(answer), indent=1, allow_nan=False) + "\n"
    if str(path) == "-":
        write_out(text)
    else:
        write_whole(path, text)


def write_out(text: str) -> None:
    """Write text for machines, printable already, to standard output."""
    import typer

    typer.echo(text, nl=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value
