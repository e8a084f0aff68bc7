"""What holds for every test: where the real data lies, where vcan0 is needed, and that CI skips nothing else."""

import os
import re
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NO_REALDATA, NO_RERUN = "no real recordings", "rerun-sdk is not installed"
"""The reasons to skip that hold in CI too: recordings are no part of this repository, and a package of 500 MB for one
option of one command is not asked of everybody who runs the tests."""
PATIENCE = 3600.0
"""A browser that has not shown a page by then hangs, on a busy machine too [s]."""
IN_CI = os.environ.get("CI", "").lower() == "true"

HEARD = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGHUP: signal.SIG_DFL,
    signal.SIGQUIT: signal.SIG_DFL,
}
"""Signals that a shell's background and nohup have a program ignore: tests send them, and children inherit that."""
for number, handler in HEARD.items():
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, handler)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """A run of the whole suite's tests on vcan0 imports their few files alone; a user-mode kernel takes long to."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if whole and config.option.markexpr.startswith("vcan") and collection_path.suffix == ".py":
        return "mark.vcan" not in collection_path.read_text(encoding="utf-8") or None
    return None


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Cases beyond a test's sample are long; files with slow tests first, so that no process is left alone with one."""
    counts: Counter[str] = Counter()
    for item in items:
        sample, name = item.get_closest_marker("sample"), item.nodeid.partition("[")[0]
        counts[name] += 1
        if sample is not None and counts[name] > sample.args[0]:
            item.add_marker(pytest.mark.long)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real recordings, which are not part of this repository."""
    folder = Path(os.environ.get("ARMLINK_REALDATA", ROOT.parent / "shared" / "realdata"))
    if not folder.is_dir():
        pytest.skip(f"{NO_REALDATA}: {folder} is missing (set ARMLINK_REALDATA)")
    return folder


@pytest.fixture(autouse=True)
def _no_store_of_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command's `--store` holds for the rest of its process."""
    monkeypatch.setenv("ARMLINK_STORE", "")


@pytest.fixture(autouse=True)
def _vcan(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("vcan") and not Path("/sys/class/net/vcan0").exists():
        why = os.environ.get("ARMLINK_NO_VCAN", "run it with scripts/with-vcan .venv/bin/pytest -m vcan")
        pytest.skip(f"needs a SocketCAN interface vcan0: {why}")


@dataclass(frozen=True)
class Look:
    """A page as Chromium showed it: picture file, document after its scripts ran, what they wrote to the console."""

    picture: Path
    document: str
    console: tuple[str, ...]

    def colours(self) -> int:
        """How many different colours the picture has; a blank page has one."""
        from PIL import Image

        with Image.open(self.picture) as image:
            return len(image.convert("RGB").getcolors(maxcolors=image.width * image.height) or ())


@pytest.fixture
def look(tmp_path: Path) -> Callable[..., Look]:
    """Opens an HTML file in a real headless Chromium and says what it looked like."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium: scripts/install-system installs it where that is allowed")
    quiet = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    command = [chromium, *quiet.split(), "--disable-component-update", "--disable-sync", "--hide-scrollbars"]
    command += ["--virtual-time-budget=5000", "--enable-logging=stderr"]

    def open_page(page: Path, width: int = 1200, height: int = 2000) -> Look:
        picture, profile = (tmp_path / f"{page.stem}-{width}-{height}.{kind}" for kind in ("png", "profile"))
        options = [f"--window-size={width},{height}", f"--screenshot={picture}", "--dump-dom"]
        complete = [*command, f"--user-data-dir={profile}", *options, page.resolve().as_uri()]
        done = subprocess.run(complete, capture_output=True, text=True, timeout=PATIENCE, check=True)
        return Look(picture, done.stdout, tuple(re.findall(r"CONSOLE[^\]]*\] (.*)", done.stderr)))

    return open_page


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    return _skip_fails_in_ci((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    return _skip_fails_in_ci((yield))


def _skip_fails_in_ci(report):
    if (
        IN_CI
        and report.skipped
        and not hasattr(report, "wasxfail")
        and not any(reason in report.longrepr[2] for reason in (NO_REALDATA, NO_RERUN))
    ):
        report.outcome = "failed"
        report.longrepr = f"in CI nothing may be skipped: {report.longrepr[2]}"
    return report
