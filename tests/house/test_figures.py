"""Figures of the house: none exceeds its ceiling in figures.json. `python tests/house/test_figures.py` prints them.

A change that lowers a figure lowers its ceiling with it. One that raises a ceiling says why in its commit message.
"""

import ast
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
CEILINGS = Path(__file__).with_name("figures.json")
PACKAGES = ("armlink", "gcomp", "calib", "sim_bus", "sim_gap")
STUB_LINES = 40
"""A module with fewer lines is a stub; `__init__.py` is none."""


def is_number(node: ast.expr | None) -> bool:
    """Whether an expression consists of numbers alone, tuples and lists of them included."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) and is_number(right)
        case ast.Tuple(elts=values) | ast.List(elts=values):
            return bool(values) and all(is_number(value) for value in values)
    return False


def is_number_constant(node: ast.stmt) -> bool:
    """Whether a statement of a module gives a number to a name in capitals."""
    match node:
        case (
            ast.Assign(targets=[ast.Name(id=name), *_], value=value)
            | ast.AnnAssign(target=ast.Name(id=name), value=value)
        ):
            return name.isupper() and is_number(value)
    return False


def measure(root: Path) -> dict[str, int]:
    """Figure → count, for the packages below `root` and its changelog. Database migrations count nowhere."""
    figures: Counter[str] = Counter()
    definitions: Counter[str] = Counter()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            if "migrations" in path.parts:
                continue
            text = path.read_text(encoding="utf-8")
            body, lines = ast.parse(text).body, text.count("\n")
            constants = sum(is_number_constant(node) for node in body)
            figures.update({"files": 1, "lines": lines, "constants": constants})
            figures.update({f"{package}.lines": lines, f"{package}.constants": constants})
            figures["stubs"] += path.name != "__init__.py" and lines < STUB_LINES
            figures["docstrings that begin with What"] += text.count('"""What ')
            definitions.update({node.name.lstrip("_") for node in body if isinstance(node, ast.ClassDef)})
    figures["classes defined twice"] = sum(count > 1 for count in definitions.values())
    figures["changelog kB"] = math.ceil((root / "CHANGELOG.md").stat().st_size / 1000)
    return dict(figures)


def over_ceiling(figures: dict[str, int], ceilings: dict[str, int]) -> list[str]:
    """A line for each figure above its ceiling."""
    return [
        f"{name}: {count}, ceiling {ceilings[name]} (tests/house/figures.json): lower it, or raise the ceiling and "
        "give the reason in the commit message"
        for name, count in figures.items()
        if count > ceilings[name]
    ]


def test_no_figure_exceeds_its_ceiling() -> None:
    figures, ceilings = measure(ROOT), json.loads(CEILINGS.read_text())
    assert figures.keys() == ceilings.keys()
    over = over_ceiling(figures, ceilings)
    assert not over, "\n".join(over)


MODULE = '''"""A module."""

LIMIT, RATES = 1.5, (2, -3.0 * 4)
RATE: float = 1e-3
NAMES = ("a", "b")
ENABLED = True
WIDTHS = [1, 2]
small = 3


class Limits:
    """What a joint can do."""
'''


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"armlink/gate.py": MODULE}, {"constants": 2, "stubs": 1, "docstrings that begin with What": 1}),
        ({"calib/a.py": "class _Limits: ...\n", "sim_gap/b.py": "class Limits: ...\n"}, {"classes defined twice": 1}),
        ({"gcomp/__init__.py": "", "gcomp/long.py": "\n" * STUB_LINES}, {"stubs": 0, "files": 2, "gcomp.lines": 40}),
        ({"calib/records/migrations/first.py": "A = 1\n"}, {"files": 0, "constants": 0}),
        ({"CHANGELOG.md": "x" * 12_001}, {"changelog kB": 13}),
    ],
)
def test_figures_are_counted(tmp_path: Path, files: dict[str, str], expected: dict[str, int]) -> None:
    for name, text in {"CHANGELOG.md": "", **files}.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    figures: dict[str, Any] = measure(tmp_path)
    assert {name: figures.get(name, 0) for name in expected} == expected


def test_the_message_names_figure_ceiling_and_what_a_raise_needs() -> None:
    assert over_ceiling({"stubs": 5, "files": 7}, {"stubs": 4, "files": 7}) == [
        "stubs: 5, ceiling 4 (tests/house/figures.json): lower it, or raise the ceiling and give the reason in the "
        "commit message"
    ]


if __name__ == "__main__":
    print(json.dumps(measure(ROOT), indent=2))
