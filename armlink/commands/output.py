"""Answers for machines and messages for people: JSON to a file or standard output, tables to standard error."""

import json
import math
from pathlib import Path
from typing import Any


def write_json(path: Path | None, answer: Any) -> None:
    """Write `answer` as JSON to `path` (`-`: standard output, None: nowhere); what is not finite becomes null."""
    if path is None:
        return
    text = json.dumps(_finite(answer), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if str(path) == "-":
        import typer

        typer.echo(text, nl=False)
    else:
        path.write_text(text, encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value
