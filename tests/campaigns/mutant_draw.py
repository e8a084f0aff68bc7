"""Campaign: mutants drawn over the five packages. Nine of ten must be noticed by the tests of their package.

python tests/campaigns/mutant_draw.py [--draw 500] [--seed 23] --record tests/armlink tests/calib …
python tests/campaigns/mutant_draw.py [--draw 500] [--seed 23] [--journal FILE] [--limit 50] [--again | --report]
python tests/campaigns/mutant_draw.py --explain KEY "why no test can tell it from the original"

Every mutant has a key: a digest of seed, module, line of source and change. Those with the lowest keys are drawn, so
that a change of other lines leaves the draw as it is. `--record tests/calib …` first runs tests without a mutant, and
notes which of them come past which mutants of the draw (.mutant_reach.json, which adds up). A mutant is then judged by
the tests that come past it, the cheapest first, within a limit of processor time. All tests are collected once, and run
in forked children with the mutant put into the functions that are loaded; where that cannot be done, everything is
loaded anew. A test that notices, or hangs, must do so twice, and pass without the mutant in between.

What was found is appended to the journal, one line of JSON each; a mutant that has a line is not judged again, so that
the runs of several days add up. `--again` judges the survivors once more, by tests that were added. Exit status 1 if
less than nine of ten are noticed, a survivor has no explanation, or mutants of the draw are not judged yet.
"""

import argparse
import functools
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import mutant_probes
from mutant_reach import Reach
from mutant_runs import Collected, collected, failing, module_name
from mutants import PACKAGES, ROOT, mirrors
from mutations import Mutant, mutants

JOURNAL = Path(__file__).parent / "mutant_draw.jsonl"
SECONDS = 40.0
"""Time of the tests by which one mutant is judged, as they take it without [s]."""
SLOWEST = 4.0
"""How many times as long they may take with it."""
FEW = 5
"""Tests that judge a mutant that none comes past."""
ASKED = 0.9
NONE = "no change"
"""What is said of a mutant that is written another way only."""


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


def chosen(reach: Reach, each: Drawn, seconds: float) -> list[str]:
    """Tests that come past a mutant, the cheapest first, those that name its module before others; as many as its time
    allows. Where none does, a few of the nearest, which may notice that the module cannot be loaded.
    """
    files = tuple(f"{file}::" for file in mirrors(each.target))

    def seconds_of(test: str) -> float:
        seen = reach.tests[test]
        return max(seen["cpu"], 0.5 * seen["clock"]) + 0.02

    def cost(test: str) -> float:
        return seconds_of(test) * (1 if test.startswith(files) else 4)

    tests, spent = [], 0.0
    for test in sorted(reach.of(each.key), key=cost):
        spent += seconds_of(test)
        if tests and spent > seconds:
            break
        tests.append(test)
    return tests or sorted(reach.near(each.target), key=cost)[:FEW]


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


def record(drawn: list[Drawn], tests: list[str]) -> None:
    """Record which of the tests come past which mutants."""
    places = defaultdict[str, list[tuple[str, int]]](list)
    for each in drawn:
        places[each.target].append((each.key, each.mutant.lines.start))
    with tempfile.TemporaryDirectory(prefix="armlink-reach-") as folder:
        for target, found in places.items():
            mutant_probes.write(Path(folder), module_name(target), ROOT / target, found)
        os.environ[mutant_probes.FILE] = str(Path(folder) / "reached")
        subprocess.run([sys.executable, str(Path(__file__).parent / "mutant_reach.py"), folder, *tests], check=True)


class Judge:
    """Judges mutants one after the other, with their tests collected."""

    def __init__(self, journal: Journal, todo: list[tuple[Drawn, list[str]]]) -> None:
        self._journal, self._todo, self._sound = journal, todo, dict[str, bool]()

    def __call__(self, server: Collected) -> None:
        """Judge all."""
        for each, tests in self._todo:
            began, source = time.monotonic(), each.mutant.source()
            by = NONE if source is None else self._one(server, each, source, tests)
            self._journal.append(key=each.key, module=each.target, mutant=each.mutant.what, by=by, tests=len(tests))
            took = f"{len(tests)} tests, {time.monotonic() - began:.1f} s"
            print(f"{each.key} {each.target}: {each.mutant.what}: {by or 'survives'} ({took})", flush=True)

    def _one(self, server: Collected, each: Drawn, source: str, tests: list[str]) -> str:
        """The test that notices, twice, and passes without the mutant; an empty text if none does."""
        tests = [test for test in server.known(tests) if self._sound.get(test, True)]
        runs = functools.partial(server.failing, each.target)
        if tests and not server.can(each.target, source):
            runs = functools.partial(failing, each.target)
        while tests and (found := runs(source, tests, SLOWEST * SECONDS)):
            test = found[0]
            if "::" not in test or (runs(source, [test], SLOWEST * SECONDS) and self._is_sound(server, test)):
                return test  # the file alone: it cannot be imported
            tests = [each for each in tests if each != test]
        return ""

    def _is_sound(self, server: Collected, test: str) -> bool:
        """Whether a test passes without a mutant."""
        if test not in self._sound:
            self._sound[test] = not server.failing("", None, [test], SLOWEST * SECONDS)
        return self._sound[test]


def judge(journal: Journal, drawn: list[Drawn], limit: int, again: bool, seconds: float) -> None:
    """Judge the mutants that have no line, or the survivors `again`; at most so many."""
    reach = Reach()

    def open_(known: dict[str, Any]) -> bool:
        return not known or (again and not known["by"] and "why" not in known)

    todo = [(each, chosen(reach, each, seconds)) for each in drawn if open_(journal.lines.get(each.key, {}))][:limit]
    if todo:
        sys.dont_write_bytecode = False  # of the tests; a mutant has none
        collected(sorted({test.split("::")[0] for _, tests in todo for test in tests}), Judge(journal, todo))


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
    parser.add_argument("--within", nargs="+", default=[""], metavar="FOLDER", help="judge those of the draw in these")
    parser.add_argument("--limit", type=int, default=10**6, help="judge at most this many now")
    parser.add_argument("--record", nargs="+", default=[], metavar="TESTS", help="note what these tests come past")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="time of the tests that judge one mutant")
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
    if given.record:
        for tests in given.record:
            record(drawn, [tests])
        return 0
    if not given.report:
        here = [each for each in drawn if each.target.startswith(tuple(given.within))]
        judge(journal, here, given.limit, given.again, given.seconds)
    return report(journal, drawn)


if __name__ == "__main__":
    sys.exit(main())
