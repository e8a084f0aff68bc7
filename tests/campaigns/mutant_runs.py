"""Tests run with a mutant, in a child process: it needs no imports of its own, and where possible no collection."""

import contextlib
import importlib
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from live_patch import Live
from mutants import OPTIONS, PACKAGES, ROOT, silence
from mutated import install, install_in_children

HANGS, STILL = 20.0, 120.0
"""A test that takes more processor time, or more time by the clock, hangs [s]."""
FINE = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED, pytest.ExitCode.INTERRUPTED)


def module_name(target: str) -> str:
    """Of a file."""
    return target.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def load() -> Live:
    """Load every module of ours, so that the children need not."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if "migrations" not in path.parts and path.name != "__main__.py":  # run, never imported
                importlib.import_module(module_name(str(path.relative_to(ROOT))))
    return Live()


def _ours(file: str | None) -> bool:
    """Whether a module is of a package of ours or of its tests."""
    path = Path(file or "/")
    first = path.relative_to(ROOT).parts[0] if path.is_relative_to(ROOT) else ""
    return first in (*PACKAGES, "tests") and path.parent != Path(__file__).parent


class Watch:
    """A pytest plugin: notes to a file which test runs and which fails, and ends the session after its time."""

    def __init__(self, notes: Path, seconds: float) -> None:
        self._notes, self._end = notes.open("a", buffering=1), time.process_time() + seconds

    @property
    def over(self) -> bool:
        """Its time."""
        return time.process_time() > self._end

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
        if self.over:
            item.session.shouldstop = "enough"


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="armlink-mutant-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def _in_child(work: Callable[[Path, Path], int], tests: list[str]) -> list[str]:
    """The tests that fail, or hang, in a child that does the work with a folder and the notes in it."""
    with _folder() as folder:
        (notes := folder / "notes").touch()
        child = os.fork()
        if child == 0:
            status: int = 70
            try:
                os.setpgid(0, 0)
                silence()
                for number in (signal.SIGALRM, signal.SIGPROF):
                    signal.signal(number, signal.SIG_DFL)
                status = work(folder, notes)
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


def failing(target: str, source: str | None, tests: list[str], seconds: float) -> list[str]:
    """The first of the tests that fails, or hangs, with this source; everything is collected and loaded with it."""

    def work(folder: Path, notes: Path) -> int:
        if source is not None:
            install(module_name(target), ROOT / target, source)
            for name in [name for name, module in sys.modules.items() if _ours(getattr(module, "__file__", None))]:
                del sys.modules[name]
            (site := folder / "site").mkdir()
            install_in_children(site, module_name(target), ROOT / target, source)
        words = [*OPTIONS, f"--basetemp={folder / 'tmp'}", "-x", *tests]
        return int(pytest.main(words, plugins=[Watch(notes, seconds)]))

    return _in_child(work, tests) if tests else []


class Collected:
    """A pytest plugin: collects once, then runs any of these tests, each time in a child.

    A mutant is put into the functions that are loaded; one outside of functions cannot be, see `live_patch`.
    """

    def __init__(self, judge: Callable[["Collected"], None]) -> None:
        self._judge = judge
        self._items: dict[str, pytest.Item] = {}

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """In place of running every test once."""
        session.config.pluginmanager.unregister(name="terminalreporter")
        self._items, self._live = {item.nodeid: item for item in session.items}, load()
        self._judge(self)
        return True

    def draws(self, test: str) -> bool:
        """Whether a test is one of many drawn examples, which takes long."""
        return hasattr(getattr(self._items[test], "function", None), "hypothesis")

    def known(self, tests: list[str]) -> list[str]:
        """Those that are still there; of a file all."""
        files = {test for test in tests if "::" not in test}
        inside = [test for test in self._items if test.partition("::")[0] in files]
        return [*(test for test in tests if test in self._items), *inside]

    def can(self, target: str, source: str) -> bool:
        """Whether a mutant can be put in."""
        return self._live.patch(ROOT / target, source, only_ask=True)

    def failing(self, target: str, source: str | None, tests: list[str], seconds: float) -> list[str]:
        """The first of the tests that fails, or hangs, with this source."""
        items = [self._items[test] for test in self.known(tests)]

        def work(folder: Path, notes: Path) -> int:
            if source is not None:
                self._live.patch(ROOT / target, source)
                (site := folder / "site").mkdir()
                install_in_children(site, module_name(target), ROOT / target, source)
            config = items[0].config
            config._tmp_path_factory._given_basetemp = folder / "tmp"  # type: ignore[attr-defined]
            config.pluginmanager.register(watch := Watch(notes, seconds))
            for item, following in zip(items, [*items[1:], None], strict=True):
                config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if watch.over or item.session.testsfailed:
                    break
            return 0

        return _in_child(work, self.known(tests)) if items else []


def collected(tests: list[str], judge: Callable[[Collected], None]) -> int:
    """Judge with these tests collected; the exit status of pytest."""
    with _folder() as folder:
        plugins: list[Any] = [Collected(judge)]
        return int(pytest.main([*OPTIONS, f"--basetemp={folder / 'tmp'}", *tests], plugins=plugins))
