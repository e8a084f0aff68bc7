"""Campaign: mutants drawn over the five packages. Nine of ten must be noticed by the tests of their package.

python tests/campaigns/mutant_draw.py [--draw 500] [--seed 23] [--journal FILE] [--limit 50] [--again | --report]
python tests/campaigns/mutant_draw.py --explain KEY "why no test can tell it from the original"

Every mutant has a key: a digest of seed, module, line of source and change. Those with the lowest keys are drawn, so
that a change of other lines leaves the draw as it is. A mutant is judged by the tests of its module's own file, then by
those that import the module, those of its sub-package, and the others of its package, the nearest by imports first,
each within a limit of processor time; `--stages 2` leaves the last ones to a later run. A test that fails, or hangs,
must pass without the mutant.

What was found is appended to the journal, one line of JSON each; a mutant that has a line is not judged again, so that
the runs of several days add up. `--again` judges the survivors once more, by tests that were added. Exit status 1 if
less than nine of ten are noticed, a survivor has no explanation, or mutants of the draw are not judged yet.
"""

import argparse
import ast
import contextlib
import functools
import hashlib
import importlib
import json
import math
import os
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from live_patch import Live
from mutants import OPTIONS, PACKAGES, ROOT, mirrors, silence
from mutated import install, install_in_children
from mutations import Mutant, mutants

JOURNAL = Path(__file__).parent / "mutant_draw.jsonl"
LIMITS = (10.0, 10.0, 15.0, 30.0)
"""Processor time of the tests of the module's own file, that import it, of its sub-package, of its package [s]."""
NEAR = 2
"""The tests of later stages have little to do with the module: one that notices must do so twice."""
HANGS, STILL = 20.0, 240.0
"""A test that takes more processor time, or more time by the clock, hangs [s]."""
ASKED = 0.9
NONE = "no change"
"""What is said of a mutant that is written another way only."""
FINE = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED, pytest.ExitCode.INTERRUPTED)


class Drawn(NamedTuple):
    """A mutant of the draw."""

    key: str
    target: str
    mutant: Mutant


def ranking(seed: int, modules: list[str]) -> list[Drawn]:
    """Every mutant of the modules that match, in the order of the draw."""
    found = []
    for pattern in modules:
        for path in sorted(ROOT.glob(pattern)):
            target, seen = str(path.relative_to(ROOT)), Counter[str]()
            for mutant in mutants(path):
                what = mutant.what.split(": ", 1)[1]
                seen[what] += 1
                digest = hashlib.sha256(f"{seed}|{target}|{what}|{seen[what]}".encode()).hexdigest()
                found.append(Drawn(digest[:12], target, mutant))
    return sorted(found, key=lambda each: each.key)


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Modules of ours that a file names in its imports, their packages included."""
    names = set[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.update({node.module, *(f"{node.module}.{alias.name}" for alias in node.names)})
    return frozenset(name for name in names if name.split(".")[0] in PACKAGES)


@functools.cache
def importers() -> dict[str, list[str]]:
    """Module → modules that import it."""
    found = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for each in imports(path):
                found[each].append(_name(path))
    return found


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT)).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def distances(name: str) -> dict[str, int]:
    """How many imports lead from a module to this one, at least."""
    far, edge = {name: 0}, [name]
    while edge:
        following = {each for module in edge for each in importers().get(module, ()) if each not in far}
        far.update(dict.fromkeys(following, far[edge[0]] + 1))
        edge = sorted(following)
    return far


def stages(target: str) -> Iterator[list[str]]:
    """Files of tests that may notice a mutant of a module: its own, its sub-package's, its package's."""
    own = mirrors(target)
    first = [file for file in own[:1] if Path(file).name == f"test_{Path(target).name}"]
    yield first
    yield [file for file in own if file not in first]
    far, parts = distances(_name(ROOT / target)), Path(target).parts

    def nearest(folder: Path) -> list[str]:
        files = {
            path: min((far[name] for name in imports(path) if name in far), default=99)
            for path in folder.rglob("test_*.py")
        }
        return [str(path.relative_to(ROOT)) for path in sorted(files, key=lambda path: (files[path], str(path)))]

    part = nearest(ROOT / "tests" / Path(*parts[:2])) if len(parts) > 2 else []
    yield [file for file in part if file not in own]
    yield [file for file in nearest(ROOT / "tests" / parts[0]) if file not in {*own, *part}]


class Watch:
    """A pytest plugin: notes to a file which test runs and which fails, and ends the session after its time."""

    def __init__(self, notes: Path, seconds: float) -> None:
        self._notes, self._end = notes.open("a", buffering=1), time.process_time() + seconds

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Tests of many drawn examples last: the others notice most, and sooner."""
        items.sort(key=lambda item: hasattr(getattr(item, "function", None), "hypothesis"))

    def pytest_runtest_logstart(self, nodeid: str, location: object) -> None:
        self._notes.write(f"> {nodeid}\n")
        signal.setitimer(signal.ITIMER_PROF, HANGS)
        signal.setitimer(signal.ITIMER_REAL, STILL)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._notes.write(f"! {report.nodeid}\n")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self._notes.write(f"! {report.nodeid}\n")

    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> None:
        if time.process_time() > self._end:
            item.session.shouldstop = "enough"


def _run(target: str, source: str | None, words: list[str], seconds: float, notes: Path) -> int:
    """In the child: pytest with this source of the module."""
    os.setpgid(0, 0)
    silence()
    if source is not None:
        name = _name(ROOT / target)
        if not load().patch(ROOT / target, source):
            install(name, ROOT / target, source)
            for module in [each for each in sys.modules if each.split(".")[0] in PACKAGES]:
                del sys.modules[module]
        (site := notes.parent / "site").mkdir()
        install_in_children(site, name, ROOT / target, source)
    return int(pytest.main([*OPTIONS, *words], plugins=[Watch(notes, seconds)]))


def failing(target: str, source: str | None, tests: list[str], seconds: float, *options: str) -> list[str]:
    """The tests that fail, or hang, with this source. They run in a child."""
    with tempfile.TemporaryDirectory(prefix="armlink-mutant-") as folder:
        notes = Path(folder) / "notes"
        notes.touch()
        child = os.fork()
        if child == 0:
            status: int = 70
            try:
                status = _run(target, source, [*options, *tests], seconds, notes)
            except BaseException:
                notes.write_text(f"E {traceback.format_exc()}")
            finally:
                os._exit(status)
        status = os.waitpid(child, 0)[1]
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what its tests have left
        lines = notes.read_text(encoding="utf-8").splitlines()
    if lines and lines[0].startswith("E "):
        raise RuntimeError("\n".join(lines))
    found = [line[2:] for line in lines if line.startswith("!")]
    if found or (os.WIFEXITED(status) and os.WEXITSTATUS(status) in FINE):
        return found
    started = [line[2:] for line in lines if line.startswith(">")]
    return [started[-1] if started else tests[0]]


def noticed_by(target: str, source: str, places: range, unsound: list[str]) -> tuple[str, int]:
    """The test of these stages that notices a mutant, an empty text if none does; how many stages were gone through.

    Where these stages have no tests, the next one that has any is taken.
    """
    options, ran, last = ["-x", *(word for test in unsound for word in ("--deselect", test))], False, places.stop
    for place, (files, seconds) in enumerate(zip(stages(target), LIMITS, strict=True)):
        if not files or place < places.start or (ran and place >= places.stop):
            continue
        found, ran, last = failing(target, source, files, seconds, *options), True, max(last, place + 1)
        if found and (place < NEAR or failing(target, source, found[:1], seconds)):
            return found[0], last
    return "", last


class Journal:
    """What was found, by key: the last line of each counts; an explanation stays with it."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines = path, dict[str, dict[str, Any]]()
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            self._take(json.loads(line))

    def _take(self, line: dict[str, Any]) -> None:
        self.lines.setdefault(line["key"], {}).update(line)

    def append(self, **line: Any) -> None:
        """One more."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
        self._take(line)

    def unsound(self) -> list[str]:
        """Tests that fail without a mutant."""
        return [key for key, line in self.lines.items() if line.get("sound") is False]

    def confirm(self) -> None:
        """Run the tests that have noticed a mutant without one; what a test noticed that fails then is open again."""
        by = {line["by"] for line in self.lines.values() if line.get("by", NONE) not in (NONE, "")} - set(self.lines)
        tests = sorted(test for test in by if "::" in test)  # else the file could not even be imported
        bad = failing("", None, tests, math.inf) if tests else []
        for test in tests:
            self.append(key=test, sound=test not in bad)
        for key in [key for key, line in self.lines.items() if line.get("by") in bad]:
            self.append(key=key, by="", stages=0)


@functools.cache
def load() -> Live:
    """Load every module of ours, so that the children need not."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if "migrations" not in path.parts and path.name != "__main__.py":  # run, never imported
                importlib.import_module(_name(path))
    return Live()


def judge(journal: Journal, drawn: list[Drawn], limit: int, until: int, again: bool) -> None:
    """Judge the mutants that have no line, or none of the later stages, or the survivors `again`; at most so many."""
    load()
    sys.dont_write_bytecode = False  # of the tests; a mutant has none
    journal.confirm()
    for each in drawn:
        known = journal.lines.get(each.key, {"by": "", "stages": 0})
        begin = 0 if again else known["stages"]
        if known["by"] or "why" in known or begin >= until:
            continue
        if limit <= 0:
            break
        began, source = time.monotonic(), each.mutant.source()
        by, gone = NONE, until
        if source is not None:
            by, gone = noticed_by(each.target, source, range(begin, until), journal.unsound())
        limit -= 1
        journal.append(key=each.key, module=each.target, mutant=each.mutant.what, by=by, stages=gone)
        took = f"{time.monotonic() - began:.0f} s"
        print(f"{each.key} {each.target}: {each.mutant.what}: {by or 'survives'} ({took})", flush=True)
    journal.confirm()


def report(journal: Journal, drawn: list[Drawn]) -> int:
    """Say what is known of the draw; the exit status."""
    known = [journal.lines[each.key] for each in drawn if each.key in journal.lines]
    known = [line for line in known if line["by"] != NONE]
    alive = [line for line in known if not line["by"]]
    for line in alive:
        print(f"survives: {line['key']} {line['module']}: {line['mutant']} {line.get('why', 'NOT EXPLAINED')}")
    packages = Counter(line["module"].split("/")[0] for line in known)
    lived = Counter(line["module"].split("/")[0] for line in alive)
    print(", ".join(f"{name} {count - lived[name]} of {count}" for name, count in sorted(packages.items())))
    unexplained = sum("why" not in line for line in alive)
    share = 1 - len(alive) / max(1, len(known))
    print(
        f"{len(drawn)} drawn, {len(known)} judged, {share:.1%} noticed; {len(alive)} survive, {unexplained} unexplained"
    )
    return int(share < ASKED or unexplained > 0 or any(each.key not in journal.lines for each in drawn))


def main() -> int:
    """Draw, judge, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", type=int, default=500)
    parser.add_argument("--seed", type=int, default=23)
    parser.add_argument("--journal", type=Path, default=JOURNAL)
    parser.add_argument("--modules", nargs="+", default=[f"{name}/**/*.py" for name in PACKAGES], metavar="GLOB")
    parser.add_argument("--limit", type=int, default=10**6, help="judge at most this many now")
    parser.add_argument("--stages", type=int, default=len(LIMITS), help="judge by the first of the stages only")
    parser.add_argument("--again", action="store_true", help="judge the survivors that have no explanation once more")
    parser.add_argument("--report", action="store_true", help="judge none, say what is known")
    parser.add_argument("--explain", nargs=2, metavar=("KEY", "WHY"))
    given = parser.parse_args()
    given.journal = given.journal.resolve()
    os.chdir(ROOT)
    journal = Journal(given.journal)
    if given.explain:
        journal.append(key=given.explain[0], why=given.explain[1])
        return 0
    drawn = ranking(given.seed, given.modules)[: given.draw]
    if not given.report:
        judge(journal, drawn, given.limit, given.stages, given.again)
    return report(journal, drawn)


if __name__ == "__main__":
    sys.exit(main())
