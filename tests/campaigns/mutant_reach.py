"""Which tests come past which mutants of a draw, and what each test takes: recorded by one run without mutants.

python tests/campaigns/mutant_reach.py FOLDER-WITH-PROBES TESTS... (mutant_draw starts it)
"""

import json
import os
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

os.environ.update(PYTEST_DISABLE_PLUGIN_AUTOLOAD="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
import mutant_probes
import pytest

ROOT = Path(__file__).parent.parent.parent
OPTIONS = ["-q", "-p", "no:cacheprovider", "-m", "not vcan and not slow"]
MOST, STILL = 5.0, 30.0
"""Processor time and time by the clock after which a test is cut short: it is too dear to judge mutants by [s]."""


class Record:
    """A pytest plugin: times the tests, tells the probes what a fixture of several tests reaches."""

    def __init__(self, probe: mutant_probes.Probe) -> None:
        self._probe = probe
        self.tests, self.failed = dict[str, dict[str, Any]](), set[str]()
        signal.signal(signal.SIGPROF, self._cut)
        signal.signal(signal.SIGALRM, self._cut)

    @staticmethod
    def _cut(number: int, frame: FrameType | None) -> None:
        pytest.fail("takes too long")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """What it reaches, all of its tests do."""
        before = self._probe.fixture
        if fixturedef.scope != "function":
            self._probe.fixture = f"fixture {fixturedef.baseid}:{fixturedef.argname}"
        try:
            return (yield)
        finally:
            self._probe.fixture = before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Each test's time and wide fixtures."""
        children = os.times()
        cpu, clock = time.process_time(), time.monotonic()
        signal.setitimer(signal.ITIMER_PROF, MOST)
        signal.setitimer(signal.ITIMER_REAL, STILL)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            after = os.times()
            below = after.children_user + after.children_system - children.children_user - children.children_system
            wide = [
                f"fixture {each.baseid}:{each.argname}"
                for every in item._fixtureinfo.name2fixturedefs.values()
                for each in every
                if each.scope != "function"
            ]
            self.tests[item.nodeid] = {
                "cpu": round(time.process_time() - cpu + below, 3),
                "clock": round(time.monotonic() - clock, 3),
                "fixtures": wide,
            }

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """What fails without a mutant judges none."""
        if report.failed:
            self.failed.add(report.nodeid)


class Reach:
    """What was recorded, in a file that adds up."""

    def __init__(self, path: Path = ROOT / ".mutant_reach.json") -> None:
        self.path = path
        self.tests, self.hits = dict[str, dict[str, Any]](), dict[str, list[str]]()
        if path.exists():
            content = json.loads(path.read_text(encoding="utf-8"))
            self.tests, self.hits = content["tests"], content["hits"]

    def add(self, tests: dict[str, dict[str, Any]], lines: list[str]) -> None:
        """One more run; of the same tests the later one counts."""
        found = defaultdict[str, set[str]](set)
        for key, owners in self.hits.items():
            found[key] = set(owners).difference(tests)
        for key, owner in (line.split("\t", 1) for line in lines):
            if owner:
                found[key].add(owner)
        self.tests.update(tests)
        self.hits = {key: sorted(owners) for key, owners in found.items()}
        self.path.write_text(json.dumps({"tests": self.tests, "hits": self.hits}), encoding="utf-8")

    def of(self, key: str) -> list[str]:
        """Tests that come past a mutant and pass without it."""
        owners = set(self.hits.get(key, ()))
        return [
            test
            for test, seen in self.tests.items()
            if not seen["failed"] and (test in owners or owners.intersection(seen["fixtures"]))
        ]

    def near(self, target: str) -> list[str]:
        """Tests in the folder that mirrors a module's, or the nearest above that has any."""
        for folder in Path(target).parents:
            found = [test for test in self.tests if test.startswith(f"{Path('tests') / folder}/")]
            if found := [test for test in found if not self.tests[test]["failed"]]:
                return found
        return []


def main() -> int:
    """Record."""
    folder, tests = Path(sys.argv[1]), sys.argv[2:]
    os.chdir(ROOT)
    mutant_probes.install_in_children(folder)
    probe = mutant_probes.install(folder)
    record = Record(probe)
    status = pytest.main([*OPTIONS, f"--basetemp={folder / 'tmp'}", *tests], plugins=[record])
    for test, seen in record.tests.items():
        seen["failed"] = test in record.failed
    reach = Reach()
    reach.add(record.tests, Path(os.environ[mutant_probes.FILE]).read_text(encoding="utf-8").splitlines())
    print(f"{len(record.tests)} tests recorded, {len(record.failed)} of them fail or take too long")
    return int(status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED))


if __name__ == "__main__":
    sys.exit(main())
