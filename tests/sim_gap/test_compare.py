"""Several models on the same recordings: the true one first, and one that is as good is told so."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from servo_arm import model_text, record
from wrong_arms import THREE, Wrong
from wrong_arms import model as wrong_model
from wrong_arms import record as wrong_record

from armlink.cli import run
from armlink.errors import BadInput
from armlink.recording.files import save_recording
from sim_gap.compare import _ranked, compare_models


@pytest.fixture
def models(tmp_path: Path) -> list[str]:
    """The true arm, one with another gain, and one without actuators."""
    kp = float(np.random.default_rng(1128).uniform(8.0, 14.0))
    true, wrong = model_text(kp, 0.1), model_text(1.6 * kp, 0.1)
    bare = true[: true.index("<actuator>")] + "</mujoco>"
    paths = []
    for name, text in (("wrong", wrong), ("true", true), ("bare", bare)):
        path = tmp_path / f"{name}.xml"
        path.write_text(text, encoding="utf-8")
        paths.append(str(path))
    for k in range(2):
        save_recording(record(true, 1128 + k, 12.0), tmp_path / f"run_{k}.csv")
    paths.append(str(kp))
    return paths


def test_the_true_model_is_first_in_windows_and_running_free(models: list[str], tmp_path: Path, capsys) -> None:
    heldout = [f"--heldout={tmp_path / f'run_{k}.csv'}" for k in range(2)]
    answer = tmp_path / "models.json"
    assert run(["gap", "compare", f"--sim={models[0]}", f"--sim={models[1]}", *heldout, f"--json={answer}"]) == 0
    found = json.loads(answer.read_text())
    assert [Path(each["model"]).stem for each in found["models"]] == ["true", "wrong"]
    best, worst = found["models"]
    assert [each["as_good_as_best"] for each in (best, worst)] == [True, False]
    assert found["unit"] == "rad"
    for joint in found["joints"]:
        here, there = (each["joints"][joint] for each in (best, worst))
        assert here["windows"]["value"] < 2e-3 < there["windows"]["value"]
        assert here["free"] < there["free"]
        low, high = there["windows"]["ci95"]
        assert low < there["windows"]["value"] < high
    assert "true.xml leaves the smallest gap" in " ".join(capsys.readouterr().out.split())


def test_known_gains_stand_in_for_actuators(models: list[str], tmp_path: Path) -> None:
    heldout = [f"--heldout={tmp_path / 'run_0.csv'}"]
    command = ["gap", "compare", f"--sim={models[2]}", f"--sim={models[2]}", *heldout, f"--json={tmp_path / 'a.json'}"]
    assert run(command) == 2
    assert run([*command, f"--gains=kp={models[3]},kd=0"]) == 0
    found = json.loads((tmp_path / "a.json").read_text())
    assert all(each["rms"]["value"] < 2e-3 for each in found["models"])
    assert all(each["as_good_as_best"] for each in found["models"])


def test_gains_beside_torques_are_refused_and_what_was_corrected_is_told(tmp_path: Path, capsys) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(THREE, encoding="utf-8")
    made = wrong_record(wrong_model(), Wrong(), seconds=20.0, rate=50.0)
    save_recording(replace(made, torque=made.torque * np.array([1.0, -1.0, 1.0])), tmp_path / "run.csv")
    command = ["gap", "compare", f"--sim={path}", f"--sim={path}", f"--heldout={tmp_path / 'run.csv'}"]
    assert run([*command, "--gains=kp=20"]) == 2
    assert "--gains: leave this option out, since the recordings have a torque channel" in capsys.readouterr().err
    assert run([*command, f"--json={tmp_path / 'a.json'}"]) == 0
    checks = json.loads((tmp_path / "a.json").read_text())["checks"]
    assert [(each["model"], each["option"]) for each in checks] == 2 * [(str(path), "--sign tau_2=-1")]
    assert "the sign is opposite" in " ".join(capsys.readouterr().out.split())


def test_models_of_other_joints_are_refused(models: list[str], tmp_path: Path) -> None:
    text = Path(models[0]).read_text().replace('"elbow"', '"knee"')
    other = tmp_path / "other.xml"
    other.write_text(text, encoding="utf-8")
    recording = record(text, 1, 8.0)
    unnamed = replace(recording, names=())
    with pytest.raises(BadInput, match="its joints are shoulder, elbow, but the other models have shoulder, knee"):
        compare_models([str(other), models[0]], [unnamed])


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_intervals_hold_as_often_as_they_say(spread: float) -> None:
    """RMS of normal gaps over windows, whose scale varies from window to window by `spread`."""
    random, hits, tries = np.random.default_rng(1128), 0, 60
    for _ in range(tries):
        scale = np.exp(spread * random.standard_normal((1, 1, 40)))
        squares = 25.0 * scale**2 * random.chisquare(50, (1, 1, 40)) / 50.0
        found = _ranked(["a"], squares, np.ones((1, 40)) * 1.0, [], "rad", ("j",)).models[0]
        truth = 5.0 * np.exp(spread**2)
        hits += found.low[0] <= truth <= found.high[0]
    assert hits >= 0.78 * tries
