"""Campaign: mutants of the gate and the bus guard. Each changes one thing; the tests must notice every one.

python tests/campaigns/mutants.py [--only gate.py] [--list]
python tests/campaigns/mutants.py --modules 'sim_gap/attribution/*.py' [--draw 500] [--seed 0]

With --modules those of any modules, by the tests that mirror each: its own file, those that import it, else the rest of
its folder; --draw takes so many of them at random. Of these tests run those that run the mutant's lines. Exit status 1
if a mutant survives that EXPLAINED does not name. A mutant that hangs counts as noticed.

Operators: comparisons, arithmetic, signs, and/or, not, conditions negated and fixed, numbers, empty texts, min/max,
ceil/floor, round/int, abs left out, returned and assigned values replaced by None.
"""

import argparse
import contextlib
import functools
import importlib
import importlib.util
import os
import pickle
import random
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FrameType
from typing import Any

os.environ.update(PYTEST_DISABLE_PLUGIN_AUTOLOAD="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
import hypothesis.strategies  # noqa: F401  (here, so that the children need not)
import numpy  # noqa: F401
import pydantic  # noqa: F401
import pytest
import yaml  # noqa: F401
from mutated import install
from mutations import Mutant, mutants

sys.dont_write_bytecode = True

ROOT = Path(__file__).parent.parent.parent
TARGETS = {
    "armlink/link/gate.py": ["tests/armlink/link/test_gate.py", "tests/armlink/link/test_gate_leash.py"],
    "armlink/link/gate_limits.py": ["tests/armlink/link/test_gate_limits.py"],
    "armlink/guard/bus_guard.py": ["tests/armlink/guard/test_bus_guard.py"],
    "armlink/drives/canopen/cia402.py": ["tests/armlink/drives/canopen/test_cia402.py"],
}
PACKAGES = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")
EXPLAINED = {
    "int becomes round": "a mode is a whole number, and round() of one is that number",
    "0x10, 0x20': 16 becomes 17": "bit 0 is set by enable already",
    "0x10, 0x20': 32 becomes 33": "bit 0 is set by enable already",
    "(0 if acknowledged else NEW_SET_POINT)': 0 becomes 1": "bit 0 is set by enable already",
    "bool(supported >> (mode - 1) & 1))': 32 becomes 33": "6502h has 32 bits: there is none for mode 33",
    "in POSITION_MODES else 0.0):': 0.0 becomes 1.0": "stands for a mode that needs no number; any finite one does",
    "value if lower <= value <= upper else max(lower, min(upper, value))': condition always false": "the quick way out",
    "value if lower <= value <= upper else max(lower, min(upper, value))': LtE becomes Lt": "max and min do the same",
    "for each in began)': Lt becomes LtE": "a number at the bound itself is within it",
    "for each in began)': Gt becomes GtE": "a number at the bound itself is within it",
    "'if self.rate != math.inf:': condition always true": "the room of a rate without bound is not asked for",
    "(goal if goal > upper else upper) + room:': Lt becomes LtE": "a goal at the bound is the bound",
    "(goal if goal > upper else upper) + room:': Gt becomes GtE": "a goal at the bound is the bound",
    "'return \"\"': returns None": "asked only whether it is true; the field of Passed has its own default",
}
"""Part of a mutant's description → why no test can tell it from the original."""
OPTIONS = ["-q", "-p", "no:cacheprovider", "-m", "not vcan and not slow"]
SURVEY_SECONDS = 8.0
"""Processor time of the tests of a module, after which no further one is looked at [s]."""
SECONDS = 120
"""A mutant that takes more processor time hangs [s], and is noticed by that."""


class Broken(Exception):
    """A module whose tests fail as it is."""


def noticed(target: str, source: str, tests: list[str]) -> bool:
    """Whether the tests fail, or hang, on a mutant's source; they run in a child of this process."""
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        silence()
        name = target.removesuffix(".py").replace("/", ".")
        install(name, ROOT / target, source)
        status = pytest.main([*OPTIONS, "-x", *tests])
        os._exit(0 if status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED) else 1)
    return os.waitpid(child, 0)[1] != 0


class Survey:
    """A pytest plugin: which tests run which lines of a module, and how long they take."""

    def __init__(self, target: str) -> None:
        self.file = str(ROOT / target)
        self.lines: dict[str, set[int]] = {"": set()}
        """Test → lines; those of the import by no test's name."""
        self.seconds: dict[str, float] = {}
        self._now = self.lines[""]

    def trace(self, frame: FrameType, event: str, value: object) -> Callable[..., object] | None:
        """For sys.settrace: of frames in the module, every line."""
        if frame.f_code.co_filename != self.file:
            return None
        self._now.add(frame.f_lineno)
        return self._line

    def _line(self, frame: FrameType, event: str, value: object) -> Callable[..., object]:
        self._now.add(frame.f_lineno)
        return self._line

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Each test's own lines; no further test beyond the time for a survey."""
        before, self._now = time.process_time(), self.lines.setdefault(item.nodeid, set())
        sys.settrace(self.trace)
        try:
            return (yield)
        finally:
            self._now, self.seconds[item.nodeid] = self.lines[""], time.process_time() - before
            if sum(self.seconds.values()) > SURVEY_SECONDS:
                item.session.shouldstop = "enough"

    def run(self, tests: list[str]) -> dict[str, Any]:
        """In a child: what the tests run, and which foreign modules they load; raises Broken if one fails."""
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ours)
            silence()
            sys.settrace(self.trace)
            threading.settrace(self.trace)
            status = pytest.main([*OPTIONS, *tests], plugins=[self])
            sys.settrace(None)
            foreign = [name for name in sys.modules if name.split(".")[0] not in (*PACKAGES, "__main__")]
            ok = status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED, pytest.ExitCode.INTERRUPTED)
            with os.fdopen(theirs, "wb") as pipe:
                pickle.dump({"ok": ok, "lines": self.lines, "seconds": self.seconds, "foreign": foreign}, pipe)
            os._exit(0)
        os.close(theirs)
        with os.fdopen(ours, "rb") as pipe:
            content = pipe.read()
        os.waitpid(child, 0)
        found: dict[str, Any] = pickle.loads(content)
        if not found["ok"]:
            raise Broken("its tests fail without a mutant")
        for name in found["foreign"]:  # so that the children that follow need not
            module = sys.modules.get(name) or _spec(name)
            if module is not None and "site-packages" in str(getattr(module, "origin", "")):
                with contextlib.suppress(Exception):
                    importlib.import_module(name)
        return found


def _spec(name: str) -> ModuleSpec | None:
    with contextlib.suppress(Exception):
        return importlib.util.find_spec(name)
    return None


def silence() -> None:
    """Nothing is printed from now on, in this process."""
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)


def tests_of(mutant: Mutant, found: dict[str, Any]) -> list[str]:
    """The tests that run a mutant's lines, the quickest first; of what runs at the import, all that use the module."""
    lines: dict[str, set[int]] = found["lines"]
    tests = [test for test, run in lines.items() if test and run.intersection(mutant.lines)]
    if not tests and lines[""].intersection(mutant.lines):
        tests = [test for test, run in lines.items() if test and run] or [test for test in lines if test]
    return sorted(tests, key=lambda test: found["seconds"].get(test, 0.0))


def _parts(tests: list[str], files: list[str]) -> list[list[str]]:
    """The tests of the first file that has any, which mostly notice; then the others."""
    first = next((file for file in files if any(test.startswith(file + "::") for test in tests)), "")
    parts = [[test for test in tests if test.startswith(first + "::") is mine] for mine in (True, False)]
    return [part for part in parts if part]


def mirrors(target: str) -> list[str]:
    """Tests of a module: the file that mirrors it, those that import it, else the others of its folder."""
    folder, name = ROOT / "tests" / Path(target).parent, target.removesuffix(".py").replace("/", ".")
    package, _, last = name.rpartition(".")
    imports = re.compile(rf"(from|import) {re.escape(name)}\b|from {re.escape(package)} import .*\b{last}\b")
    own = folder / f"test_{Path(target).name}"
    found = [own] if own.exists() else []
    found += [path for path, text in texts().items() if path != own and imports.search(text)]
    while not found and folder != ROOT / "tests":
        found, folder = sorted(folder.glob("test_*.py")), folder.parent
    return [str(path.relative_to(ROOT)) for path in found]


@functools.cache
def texts() -> dict[Path, str]:
    """Every file of tests, those of the packages first."""
    return {path: path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("tests/*/**/test_*.py"))}


def chosen(patterns: list[str], draw: int, first: int, seed: int) -> dict[str, list[Mutant]]:
    """Module → its mutants, of the modules that match; `draw` of them all, 0 for every one, the `first` of those."""
    targets = [str(path.relative_to(ROOT)) for pattern in patterns for path in sorted(ROOT.glob(pattern))]
    targets = [target for target in targets if target.split("/")[0] in PACKAGES]
    pairs = [(target, mutant) for target in targets for mutant in mutants(ROOT / target)]
    if draw and draw < len(pairs):
        pairs = random.Random(seed).sample(pairs, draw)
    pairs = sorted(pairs[: first or None], key=lambda pair: targets.index(pair[0]))
    found: dict[str, list[Mutant]] = {}
    for target, mutant in pairs:
        found.setdefault(target, []).append(mutant)
    return found


def judged(target: str, found: list[Mutant], tests: list[str]) -> tuple[int, int]:
    """How many mutants survive, and how many of them without an explanation; raises Broken."""
    seen = Survey(target).run(tests)
    alive = unexplained = 0
    for mutant in found:
        by, source = tests_of(mutant, seen), mutant.source()
        if source is None or any(noticed(target, source, part) for part in _parts(by, tests)):
            continue
        why = next((why for part, why in EXPLAINED.items() if part in mutant.what), "")
        alive, unexplained = alive + 1, unexplained + (not why)
        said = f" (explained: {why})" if why else "" if by else " (no test runs it)"
        print(f"survives: {target}: {mutant.what}{said}", flush=True)
    print(f"{target}: {len(found)} mutants, {len(found) - alive} noticed, {alive} survive", flush=True)
    return alive, unexplained


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="file name, such as gate.py")
    parser.add_argument("--match", default="", help="mutants with this in what is said of them, such as gate.py:13")
    parser.add_argument("--list", action="store_true", help="say what the mutants are, and end")
    parser.add_argument("--modules", nargs="+", default=[], metavar="GLOB", help="modules, instead of the gate's")
    parser.add_argument("--draw", type=int, default=0, help="this many mutants of the modules, at random")
    parser.add_argument("--first", type=int, default=0, help="the first of those drawn, in the order of the draw")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.chdir(ROOT)
    if given.modules:
        drawn = chosen(given.modules, given.draw, given.first, given.seed)
        work = [(target, found, mirrors(target)) for target, found in drawn.items()]
    else:
        targets = {target: tests for target, tests in TARGETS.items() if given.only in ("", Path(target).name)}
        work = [(target, list(mutants(ROOT / target)), tests) for target, tests in targets.items()]
    work = [(target, [each for each in found if given.match in each.what], tests) for target, found, tests in work]
    if given.list:
        print("\n".join(f"{target}: {each.what}" for target, found, _ in work for each in found))
        return 0
    survivors = unexplained = total = left_out = 0
    start = time.monotonic()
    for target, found, tests in work:
        try:
            alive, unknown = judged(target, found, tests)
        except Broken as broken:
            print(f"{target}: {broken}", flush=True)
            left_out += len(found)
            continue
        survivors, unexplained, total = survivors + alive, unexplained + unknown, total + len(found)
    took = time.monotonic() - start
    print(f"{total} mutants, {survivors} survive, {unexplained} of them unexplained; {took:.0f} s")
    if left_out:
        print(f"{left_out} more not judged: their tests fail without a mutant")
    return int(unexplained + left_out > 0)


if __name__ == "__main__":
    sys.exit(main())
