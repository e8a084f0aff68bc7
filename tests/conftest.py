"""What holds for every test: where the real data lies, where vcan0 is needed, and that CI skips nothing."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
IN_CI = os.environ.get("CI", "").lower() == "true"


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real recordings, which are not part of this repository."""
    folder = Path(os.environ.get("ARMLINK_REALDATA", ROOT.parent / "shared" / "realdata"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is missing (set ARMLINK_REALDATA)")
    return folder


@pytest.fixture(autouse=True)
def _vcan(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("vcan") and not Path("/sys/class/net/vcan0").exists():
        why = os.environ.get("ARMLINK_NO_VCAN", "run it with scripts/with-vcan .venv/bin/pytest -m vcan")
        pytest.skip(f"needs a SocketCAN interface vcan0: {why}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    return _skip_fails_in_ci((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    return _skip_fails_in_ci((yield))


def _skip_fails_in_ci(report):
    if IN_CI and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"in CI nothing may be skipped: {report.longrepr[2]}"
    return report
