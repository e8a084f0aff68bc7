"""The examples run unchanged, are short, and print what they promise."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from armlink.cli import run

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.py"))


def printed_by(script: str, folder: Path) -> str:
    """What a script prints when it is started from another folder; it leaves no file there."""
    command = [sys.executable, str(EXAMPLES / script)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert not list(folder.iterdir())
    return done.stdout


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_example_has_at_most_30_lines(script):
    assert len((EXAMPLES / script).read_text().splitlines()) <= 30


@pytest.mark.long
def test_calibrate_and_identify_finds_the_hidden_gains(tmp_path):
    printed = printed_by("calibrate_and_identify.py", tmp_path)
    gains = [tuple(map(float, row)) for row in re.findall(r"gain (\S+) to (\S+) \(95 %\), true (\S+)", printed)]
    assert len(gains) == 3
    for low, high, true in gains:
        assert abs((low + high) / 2 - true) < 0.004
    assert "mass moments" in printed


@pytest.mark.long
def test_observe_a_drift_names_the_joint_and_its_size(tmp_path):
    printed = printed_by("observe_a_drift.py", tmp_path)
    gain, offset = re.search(r"proposal at elbow: gain (\S+), offset (\S+) N·m", printed).groups()
    assert float(gain) == pytest.approx(1.03, abs=0.005)
    assert float(offset) == pytest.approx(0.3, abs=0.05)


@pytest.mark.long
def test_diagnose_a_gap_names_the_causes(tmp_path):
    printed = printed_by("diagnose_a_gap.py", tmp_path)
    assert printed.startswith("explained\n")
    causes = re.findall(r"^(\S+), confidence", printed, re.MULTILINE)
    assert set(causes) == {"friction.coulomb", "torque.gain"}
    assert re.search(r"torque\.gain.*'elbow': \[1\.0[34]", printed)


def test_the_arm_of_the_examples_has_its_simulated_bus_for_commands_from_any_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["scan", str(EXAMPLES / "planar3.yaml")]) == 0
    assert "wrist" in capsys.readouterr().out


def test_every_example_is_run_here():
    text = Path(__file__).read_text()
    assert all(f'printed_by("{script}"' in text for script in SCRIPTS)
