"""Campaign: mutants of the gate and the bus guard. Each changes one thing; the tests must notice every one.

python tests/campaigns/mutants.py [--only gate.py] [--list]
python tests/campaigns/mutants.py --modules 'sim_gap/attribution/*.py' [--draw 500] [--seed 0]

With --modules those of any modules, by the tests that mirror each: its own file, then the rest of its folder; --draw
takes so many of them at random. Exit status 1 if a mutant survives that EXPLAINED does not name. A mutant that hangs
counts as noticed.

Operators: comparisons, arithmetic, signs, and/or, not, conditions negated and fixed, numbers, empty texts, min/max,
ceil/floor, round/int, abs left out, returned and assigned values replaced by None.
"""

import argparse
import ast
import copy
import importlib.abc
import importlib.util
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

os.environ.update(PYTEST_DISABLE_PLUGIN_AUTOLOAD="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
import hypothesis.strategies  # noqa: F401  (here, so that the children need not)
import numpy  # noqa: F401
import pydantic  # noqa: F401
import pytest
import yaml  # noqa: F401

sys.dont_write_bytecode = True

ROOT = Path(__file__).parent.parent.parent
TARGETS = {
    "armlink/link/gate.py": ["tests/armlink/link/test_gate.py"],
    "armlink/link/gate_limits.py": ["tests/armlink/link/test_gate_limits.py"],
    "armlink/guard/bus_guard.py": ["tests/armlink/guard/test_bus_guard.py"],
    "armlink/drives/canopen/cia402.py": ["tests/armlink/drives/canopen/test_cia402.py"],
}
NEED_NO_CONFTEST = ("armlink/link/gate.py", "armlink/link/gate_limits.py", "armlink/drives/canopen/cia402.py")
"""Targets whose tests start faster without."""
PACKAGES = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")
EXPLAINED = {
    "int becomes round": "a mode is a whole number, and round() of one is that number",
    "0x10, 0x20': 16 becomes 17": "bit 0 is set by enable already",
    "0x10, 0x20': 32 becomes 33": "bit 0 is set by enable already",
    "(0 if acknowledged else NEW_SET_POINT)': 0 becomes 1": "bit 0 is set by enable already",
    "bool(supported >> (mode - 1) & 1))': 32 becomes 33": "6502h has 32 bits: there is none for mode 33",
    "0.0 becomes 1.0": "stands for a mode that needs no number; any finite one does",
    "value if lower <= value <= upper else max(lower, min(upper, value))': condition always false": "the quick way out",
    "value if lower <= value <= upper else max(lower, min(upper, value))': LtE becomes Lt": "max and min do the same",
    "for each in began)': Lt becomes LtE": "a number at the bound itself is within it",
    "for each in began)': Gt becomes GtE": "a number at the bound itself is within it",
    "'if self.rate != math.inf:': condition always true": "the room of a rate without bound is not asked for",
    "'return \"\"': returns None": "asked only whether it is true; the field of Passed has its own default",
}
"""Part of a mutant's description → why no test can tell it from the original."""
SLOW = "whoever_calls"
"""Tests by this name run only on mutants that the others did not notice."""
SECONDS = 120
"""A mutant that takes more processor time hangs [s], and is noticed by that."""
SWAPS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.RShift: (ast.LShift,),
    ast.LShift: (ast.RShift,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
}
CALLS = {"max": "min", "min": "max", "ceil": "floor", "floor": "ceil", "round": "int", "int": "round"}


class Broken(Exception):
    """A module whose tests fail as it is."""


class Mutated(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports one module from a text instead of its file."""

    def __init__(self, name: str, path: Path, source: str) -> None:
        self.name, self.path, self.source = name, path, source

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Ours for the one module."""
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def get_filename(self, name: str) -> str:
        """Where it would have come from."""
        return str(self.path)

    def get_data(self, path: str) -> bytes:
        """The text."""
        return self.source.encode()


def edits(node: ast.AST) -> Iterator[tuple[str, Callable[[ast.AST], ast.AST]]]:
    """What can be changed in one node: description and the change, which returns the node or another in its place."""

    def put(field: str, value: object) -> Callable[[ast.AST], ast.AST]:
        def change(target: ast.AST) -> ast.AST:
            setattr(target, field, value)
            return target

        return change

    if isinstance(node, ast.Compare):
        for place, op in enumerate(node.ops):
            for other in SWAPS.get(type(op), ()):
                ops = [*node.ops[:place], other(), *node.ops[place + 1 :]]
                yield f"{type(op).__name__} becomes {other.__name__}", put("ops", ops)
    elif isinstance(node, ast.BinOp | ast.BoolOp):
        for other in SWAPS.get(type(node.op), ()):
            yield f"{type(node.op).__name__} becomes {other.__name__}", put("op", other())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield f"{type(node.op).__name__} left out", lambda target: target.operand  # type: ignore[attr-defined]
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield f"{node.value} becomes {node.value + 1}", put("value", node.value + 1)
    elif isinstance(node, ast.Constant) and node.value == "":
        yield "empty text becomes another", put("value", "mutant")
    elif isinstance(node, ast.Call):
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if name in CALLS:
            field = "id" if isinstance(node.func, ast.Name) else "attr"
            yield f"{name} becomes {CALLS[name]}", lambda t: setattr(t.func, field, CALLS[name]) or t  # type: ignore[attr-defined,func-returns-value]
        if name == "abs":
            yield "abs left out", lambda target: target.args[0]  # type: ignore[attr-defined]
    elif isinstance(node, ast.If | ast.IfExp):
        yield "condition negated", put("test", ast.UnaryOp(ast.Not(), node.test))
        yield "condition always true", put("test", ast.Constant(True))
        yield "condition always false", put("test", ast.Constant(False))
    elif isinstance(node, ast.Return) and node.value is not None:
        yield "returns None", put("value", ast.Constant(None))
    elif isinstance(node, ast.Assign):
        yield "assigns None", put("value", ast.Constant(None))


class Changed(ast.NodeTransformer):
    """Puts one change at one place."""

    def __init__(self, place: int, change: Callable[[ast.AST], ast.AST]) -> None:
        self.place, self.change, self.at = place, change, -1

    def visit(self, node: ast.AST) -> ast.AST:
        """Count nodes in the order of visit; change the one."""
        self.at += 1
        if self.at == self.place:
            self.at += 10**6
            return self.change(node)
        return self.generic_visit(node)


def ordered(tree: ast.AST) -> list[ast.AST]:
    """Nodes in the order in which Changed visits them."""
    seen: list[ast.AST] = []

    class Seen(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            seen.append(node)
            return self.generic_visit(node)

    Seen().visit(copy.deepcopy(tree))
    return seen


def mutants(path: Path) -> Iterator[tuple[str, str]]:
    """(where and what, source) of every mutant of a module; docstrings and annotations stay."""
    text = path.read_text(encoding="utf-8")
    tree, lines = ast.parse(text), text.splitlines()
    for place, node in enumerate(ordered(tree)):
        for what, change in edits(node):
            line = getattr(node, "lineno", 0)
            mutated = Changed(place, change).visit(copy.deepcopy(tree))
            source = ast.unparse(ast.fix_missing_locations(mutated))
            if source != ast.unparse(tree):
                yield f"{path.name}:{line}: {lines[line - 1].strip()!r}: {what}", source


def noticed(target: str, source: str, tests: list[str]) -> bool:
    """Whether the tests fail, or hang, on a mutant's source; each runs in a child of this process."""
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        name = target.removesuffix(".py").replace("/", ".")
        sys.meta_path.insert(0, Mutated(name, ROOT / target, source))
        options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not vcan"]
        options += ["--noconftest"] * (target in NEED_NO_CONFTEST) + tests
        status = pytest.main([*options, "-k", f"not {SLOW}"]) or pytest.main([*options, "-k", SLOW])
        os._exit(0 if status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED) else 1)
    return os.waitpid(child, 0)[1] != 0


def mirrors(target: str) -> list[str]:
    """Tests of a module: the file that mirrors it, and its folder's others after it; empty if there are none."""
    folder = ROOT / "tests" / Path(target).parent
    own = folder / f"test_{Path(target).name}"
    others = sorted(path for path in folder.glob("test_*.py") if path != own)
    return [str(path.relative_to(ROOT)) for path in ([own] if own.exists() else []) + others]


def chosen(patterns: list[str], draw: int, seed: int) -> dict[str, list[tuple[str, str]]]:
    """Module → its mutants, of the modules that match; `draw` of them all, 0 for every one."""
    targets = [str(path.relative_to(ROOT)) for pattern in patterns for path in sorted(ROOT.glob(pattern))]
    targets = [target for target in targets if target.split("/")[0] in PACKAGES and mirrors(target)]
    pairs = [(target, mutant) for target in targets for mutant in mutants(ROOT / target)]
    if draw and draw < len(pairs):
        pairs = sorted(random.Random(seed).sample(pairs, draw), key=lambda pair: targets.index(pair[0]))
    found: dict[str, list[tuple[str, str]]] = {}
    for target, mutant in pairs:
        found.setdefault(target, []).append(mutant)
    return found


def judged(target: str, found: list[tuple[str, str]], tests: list[str]) -> tuple[int, int]:
    """How many mutants survive, and how many of them without an explanation; raises Broken."""
    if noticed(target, (ROOT / target).read_text(encoding="utf-8"), tests):
        raise Broken(f"{target}: its tests fail without a mutant")
    alive = unexplained = 0
    for what, source in found:
        if noticed(target, source, tests):
            continue
        why = next((why for part, why in EXPLAINED.items() if part in what), "")
        alive, unexplained = alive + 1, unexplained + (not why)
        print(f"survives: {what}{f' (explained: {why})' if why else ''}", flush=True)
    print(f"{target}: {len(found)} mutants, {len(found) - alive} noticed, {alive} survive", flush=True)
    return alive, unexplained


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="file name, such as gate.py")
    parser.add_argument("--list", action="store_true", help="say what the mutants are, and end")
    parser.add_argument("--modules", nargs="+", default=[], metavar="GLOB", help="modules, instead of the gate's")
    parser.add_argument("--draw", type=int, default=0, help="this many mutants of the modules, at random")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.chdir(ROOT)
    if given.modules:
        work = [
            (target, found, mirrors(target)) for target, found in chosen(given.modules, given.draw, given.seed).items()
        ]
    else:
        targets = {target: tests for target, tests in TARGETS.items() if given.only in ("", Path(target).name)}
        work = [(target, list(mutants(ROOT / target)), tests) for target, tests in targets.items()]
    if given.list:
        print("\n".join(what for _, found, _ in work for what, _ in found))
        return 0
    survivors = unexplained = total = 0
    start = time.monotonic()
    for target, found, tests in work:
        try:
            alive, unknown = judged(target, found, tests)
        except Broken as broken:
            print(broken)
            return 1
        survivors, unexplained, total = survivors + alive, unexplained + unknown, total + len(found)
    took = time.monotonic() - start
    print(f"{total} mutants, {survivors} survive, {unexplained} of them unexplained; {took:.0f} s")
    return int(unexplained > 0)


if __name__ == "__main__":
    sys.exit(main())
