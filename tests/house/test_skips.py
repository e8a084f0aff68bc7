"""In CI a skipped test is a failed one, real recordings apart; elsewhere its reason stands in the summary."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parent.parent / "conftest.py"
TESTS = """
import pytest
pytestmark = [{mark}]
def test_that_skips(): pytest.skip("no such thing here")
@pytest.mark.xfail(strict=True)
def test_that_is_known_to_fail(): assert False
@pytest.mark.vcan
def test_that_needs_vcan(): assert True
"""


def run_pytest(folder: Path, text: str, ci: str) -> subprocess.CompletedProcess[str]:
    (folder / "conftest.py").write_text(CONFTEST.read_text())
    (folder / "pytest.ini").write_text("[pytest]\naddopts = -ra\nmarkers = vcan\n")
    (folder / "test_it.py").write_text(text)
    environment = {**os.environ, "CI": ci, "ARMLINK_REALDATA": "/nowhere", "ARMLINK_NO_VCAN": "this kernel has no vcan"}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_outside_ci_each_skip_gives_its_reason(tmp_path):
    done = run_pytest(tmp_path, TESTS.format(mark=""), ci="")
    assert done.returncode == 0
    assert "no such thing here" in done.stdout
    assert ("this kernel has no vcan" in done.stdout) is not Path("/sys/class/net/vcan0").exists()
    assert "1 xfailed" in done.stdout


def test_in_ci_a_skip_is_a_failure(tmp_path):
    done = run_pytest(tmp_path, TESTS.format(mark=""), ci="true")
    assert done.returncode == 1
    assert "in CI nothing may be skipped" in done.stdout
    assert "1 xfailed" in done.stdout


def test_real_recordings_may_be_missing_in_ci_too(tmp_path):
    done = run_pytest(tmp_path, "def test_that_needs_them(realdata): pass\n", ci="true")
    assert done.returncode == 0
    assert "no real recordings: " in done.stdout


@pytest.mark.parametrize(("ci", "status"), [("", 5), ("true", 2)])
def test_a_whole_file_that_is_skipped_counts(tmp_path, ci, status):
    text = 'import pytest\npytest.importorskip("a_package_that_nobody_has")\ndef test_it(): pass\n'
    assert run_pytest(tmp_path, text, ci).returncode == status
