"""Sizes that a model file states, asked before MuJoCo makes what they say."""

import math
from contextlib import AbstractContextManager
from os.path import isfile
from pathlib import Path
from typing import Any
from xml.parsers import expat

from armlink.content.file_content import MOST_TEXT
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput

MOST_FILES = 100
"""Files that a model may include."""
MOST_ELEMENTS = 200_000
"""Elements of a model file; MuJoCo's largest published models have some thousands."""
MOST_COPIES = 10_000
"""Bodies that `replicate`, `composite` and `flexcomp` may make."""
MOST_PIXELS = 1 << 24
"""Points of a height field or texture: 4096 by 4096."""
MOST_SLOTS = 1 << 20
"""Keyframes, user data and other numbers of slots under `size`, and numbers of a custom field."""
MOST_ARENA = 1 << 30
"""`memory` under `size` [bytes]; MuJoCo's own choice is some megabytes."""
COPYING = ("replicate", "composite", "flexcomp")
POINTS = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}
UNITS = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30, "t": 1 << 40, "p": 1 << 50, "e": 1 << 60}


def model_budget(path: Path) -> AbstractContextManager[None]:
    """Check a model file's stated sizes; the memory budget to read it within. Raises BadInput."""
    check_sizes(path)
    return memory_budget(path)


def check_sizes(path: Path) -> None:
    """Raise BadInput, in one line, where a model file or one that it includes states more than the limits above."""
    left, seen = [path], set[Path]()
    while left:
        each = left.pop()
        if each in seen or not isfile(each):
            continue
        seen.add(each)
        if len(seen) > MOST_FILES:
            raise BadInput(f"{path}: includes more than {MOST_FILES} files")
        if each.stat().st_size > MOST_TEXT:
            raise BadInput(
                f"{each}: {each.stat().st_size / 1e6:.0f} MB, expected at most {MOST_TEXT / 1e6:.0f} MB of XML"
            )
        reader = _Sizes(each)
        left += [folder / name for name in reader.included for folder in {each.parent, path.parent}]


class _Sizes:
    """Reads one file; what is not well-formed is left for those who use it to say."""

    def __init__(self, path: Path) -> None:
        self.included: list[str] = []
        self._path, self._elements, self._copies = path, 0, [1.0]
        parser = expat.ParserCreate()
        parser.StartElementHandler, parser.EndElementHandler = self._begin, self._end
        parser.EntityDeclHandler = self._entity
        try:
            parser.Parse(path.read_bytes(), True)
        except (expat.ExpatError, OSError):
            return

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._elements += 1
        self._require(self._elements, MOST_ELEMENTS, "elements")
        copies = _product(attributes.get("count", "")) if tag in COPYING else 1.0
        self._copies.append(self._copies[-1] * copies)
        self._require(self._copies[-1], MOST_COPIES, f"copies by {tag}")
        if tag in POINTS:
            self._require(math.prod(_product(attributes.get(key, "")) for key in POINTS[tag]), MOST_PIXELS, "points")
        if tag == "numeric":
            self._require(_product(attributes.get("size", "")), MOST_SLOTS, "numbers")
        if tag == "size":
            for key, value in attributes.items():
                self._require(_product(value), MOST_ARENA if key == "memory" else MOST_SLOTS, key)
        if tag == "include" and "file" in attributes:
            self.included.append(attributes["file"])

    def _end(self, tag: str) -> None:
        self._copies.pop()

    def _entity(self, name: str, *_: Any) -> None:
        raise BadInput(f"{self._path}: declares the entity {name!r}, which no model needs: write its text out instead")

    def _require(self, value: float, most: int, what: str) -> None:
        if value > most:
            raise BadInput(f"{self._path}: {value:.6g} {what}, expected at most {most}")


def _product(text: str) -> float:
    """Product of the numbers in an attribute, with MuJoCo's units of memory; 1 where there is none."""
    found = 1.0
    for word in text.split():
        unit = UNITS.get(word[-1].lower(), 1)
        try:
            found *= max(float(word[:-1] if unit > 1 else word) * unit, 1.0)
        except ValueError:
            continue
    return found
