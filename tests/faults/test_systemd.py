"""The units of packaging/: systemd understands every line of them, and they confine their programs.

That watchdog, restart and limits work is seen by tests/campaigns/systemd_units.py, under a systemd of its own.
"""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = sorted((Path(__file__).parents[2] / "packaging").glob("*.service"))
MOST_EXPOSED = 2.5
"""Of systemd-analyze security: from 0, fully confined, to 10; "medium" begins at 5."""
NOT_HERE = "is not executable: No such file or directory"


def analyze(*words: str) -> str:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("this machine has no systemd-analyze")
    done = subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_finds_nothing_wrong_in_it(unit: Path) -> None:
    said = analyze("verify", "--man=no", str(unit)).splitlines()
    ours = [line for line in said if "armlink" in line and NOT_HERE not in line]
    assert ours == []


def test_systemd_would_find_an_unknown_key(tmp_path: Path) -> None:
    unit = tmp_path / UNITS[0].name
    unit.write_text(UNITS[0].read_text().replace("MemoryMax=", "MemoryMost="))
    assert "MemoryMost" in analyze("verify", "--man=no", str(unit))


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_it_is_confined(unit: Path) -> None:
    said = analyze("security", "--offline=true", "--no-pager", str(unit))
    found = re.search(r"Overall exposure level for .*: ([\d.]+)", said)
    assert found, said
    assert float(found[1]) <= MOST_EXPOSED


@pytest.mark.parametrize("key", ["Restart=always", "MemoryMax=", "ProtectSystem=strict", "NoNewPrivileges=yes"])
def test_both_are_started_again_and_bounded(key: str) -> None:
    assert [unit.name for unit in UNITS if key not in unit.read_text()] == []
    assert "WatchdogSec=10\n" in (UNITS[0].parent / "armlink@.service").read_text()
