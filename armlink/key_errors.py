"""Validation errors of keys in words: which key, what is wrong, the value, and the key that was probably meant."""

import difflib
import re
import typing
from collections.abc import Iterable

from pydantic import BaseModel, ValidationError

UNIT = re.compile(r"\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?\s*([^\d\s].*)")
REWORDED = ("Field required", "Field required: add it"), ("Value error, ", "")


def describe(error: ValidationError, within: str = "", of: type[BaseModel] | None = None) -> str:
    """The first of pydantic's findings as one line, and how many more there are."""
    first, *others = describe_all(error, within, of)
    more = f"; {len(others)} more" if others else ""
    key, message = first
    return f"key {key}: {message}{more}"


def describe_all(error: ValidationError, within: str = "", of: type[BaseModel] | None = None) -> list[tuple[str, str]]:
    """(Key, what is wrong with it) of all findings; `of` is the model that was validated, for likely keys.

    Unknown keys come first: a misspelt key is missing under its own name too.
    """
    order = sorted(error.errors(include_url=False), key=lambda found: found["type"] != "extra_forbidden")
    return [_finding(found, within, of) for found in order]


def suggest_key(word: str, known: Iterable[str]) -> str:
    """`; did you mean …?` where a known word is close, else `; expected one of …`."""
    words = sorted(known)
    folded = {each.casefold(): each for each in words}
    swapped = [each for each in folded if sorted(each.split("_")) == sorted(word.casefold().split("_"))]
    close = swapped or difflib.get_close_matches(word.casefold(), folded, n=1, cutoff=0.6)
    if close:
        return f"; did you mean {folded[close[0]]}?"
    return f"; expected one of {', '.join(words)}" if words else ""


def _finding(found: typing.Any, within: str, of: type[BaseModel] | None) -> tuple[str, str]:
    place, value = [str(part) for part in found["loc"]], found["input"]
    key = ".".join([within] * bool(within) + place) or "file"
    message = found["msg"]
    for old, new in REWORDED:
        message = message.replace(old, new)
    if found["type"] == "extra_forbidden":
        known = _keys(of, [part for part in found["loc"][:-1] if isinstance(part, str)])
        hint = suggest_key(place[-1], known)
        return key, f"unknown key{hint}" if hint else "unknown key; remove it or correct its spelling"
    if isinstance(value, dict | list | tuple | BaseModel):
        return key, message
    unit = UNIT.fullmatch(value) if isinstance(value, str) else None
    if unit and found["type"].startswith(("float", "int")):
        message += f"; give the number alone, without {unit[1]!r}"
    return key, f"{message} (value {_short(value)})"


def _short(value: typing.Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # a number of more digits than Python writes
        return "a number with too many digits"
    return text if len(text) <= 100 else f"{text[:100]}…"


def _keys(model: type[BaseModel] | None, way: list[str]) -> list[str]:
    """Keys that the model has at a place; empty where that is not known."""
    for part in way:
        field = None if model is None else model.model_fields.get(part)
        model = None if field is None else next(_models(field.annotation), None)
    return [] if model is None else [name for name in model.model_fields if name != "path"]


def _models(annotation: typing.Any) -> typing.Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in typing.get_args(annotation):
        yield from _models(part)
