"""Answers for machines: JSON to a file or standard output."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from armlink.content.atomic_file import write_whole, writing
from armlink.content.printable_text import printable_json


def write_json(path: Path | None, answer: Any) -> None:
    """Write `answer` as JSON to `path` (`-`: standard output, None: nowhere); NaN and infinity become null."""
    if path is None:
        return
    text = printable_json(_finite(answer), indent=1, allow_nan=False) + "\n"
    if str(path) == "-":
        write_out(text)
    else:
        write_whole(path, text)


@contextmanager
def json_lines(path: Path | None) -> Iterator[Callable[[Any], None]]:
    """A function that writes an answer as one line, without delay; `path` is that of `write_json`."""
    if path is None:
        yield lambda answer: None
    elif str(path) == "-":
        yield lambda answer: write_out(_line(answer))
    else:
        with writing(path), path.open("w", encoding="utf-8", buffering=1) as file:

            def write(answer: Any) -> None:
                file.write(_line(answer))

            yield write


def _line(answer: Any) -> str:
    return printable_json(_finite(answer), allow_nan=False) + "\n"


def write_out(text: str) -> None:
    """Write text for programs, which is printable already, to standard output."""
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
