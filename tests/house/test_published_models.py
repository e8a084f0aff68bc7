"""Five arms as their makers publish them: what `new` writes `doctor` accepts, and the demo reaches a sound report."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "campaigns"))
import published_models  # noqa: E402

MODELS = sorted((ROOT / "tests" / "models" / "published").glob("*.urdf"))


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.stem)
def test_what_new_writes_has_no_error(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "arm.yaml"
    made = published_models.command("new", str(model), "--out", str(out), seconds=600)
    assert made.returncode == 0, made.stderr
    doctor = published_models.command("doctor", str(out), "--offline", "--json", "-", seconds=600)
    found = json.loads(doctor.stdout)["findings"]
    assert [each for each in found if each["level"] == "error"] == []


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.stem)
def test_the_demo_reaches_a_sound_report(model: Path) -> None:
    outcome = published_models.judge(model, seed=2, seconds=1800)
    assert outcome.good, outcome.row()
    assert outcome.demo == "report", outcome.row()


def test_a_model_that_fails_is_told_from_one_that_is_refused() -> None:
    refused = published_models.Outcome("a", doctor="refused: joint: what: remedy")
    failed = published_models.Outcome("b", demo="failed: gate: j4 turns at 13.5 rad/s")
    doubtful = published_models.Outcome("c", demo="report", inside=12, intervals=19)
    assert [each.good for each in (refused, failed, doubtful)] == [True, False, False]
    traced = subprocess.CompletedProcess([], 1, "", "Traceback (most recent call last):\nValueError: x")
    assert "traceback" in published_models.one_line(traced)
