"""Commands sweep, calibrate, identify and verify, as a user runs them, on a simulated arm in lock-step."""

import json
from pathlib import Path

import pytest
import yaml
from sweep_arms import random_arm

from armlink.cli import run
from calib.dataset import load_data


@pytest.fixture(scope="module")
def arm_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A two-joint arm file with short sweeps."""
    arm = random_arm(31, 2)
    path = tmp_path_factory.mktemp("arm") / "bench.yaml"
    content = arm.model_dump(mode="json", exclude={"path", "sim", "sweep"}, exclude_none=True)
    content["kinematics"].pop("model", None)
    content["sim"] = {
        "links": [link.model_dump(mode="json") for link in arm.sim.links],
        "effects": [{"effect": each.effect, "joint": each.joint, **each.parameters} for each in arm.sim.effects],
    }
    content["sweep"] = {"steps": 5}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def swept(arm_path: Path) -> Path:
    out = arm_path.parent / "bare"
    assert run(["sweep", str(arm_path), "--bus", f"armlink_sim:{arm_path}", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def loaded(arm_path: Path, swept: Path) -> Path:
    """The second pass: the same arm with the recommended mass bolted on."""
    plan = load_data(swept).plan
    assert plan is not None
    mass = plan.reference_mass
    content = yaml.safe_load(arm_path.read_text(encoding="utf-8"))
    content["sim"]["effects"].append({"effect": "link.payload", "mass": mass, "com": [0.1, 0.12, 0.05]})
    heavier = arm_path.parent / "heavier.yaml"
    heavier.write_text(yaml.safe_dump(content), encoding="utf-8")
    out = arm_path.parent / "loaded"
    command = ["sweep", str(arm_path), "--bus", f"armlink_sim:{heavier}", "--out", str(out)]
    assert run([*command, "--reference-mass", str(mass)]) == 0
    return out


def test_from_sweeps_to_a_verified_model(
    arm_path: Path, swept: Path, loaded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, bus = ["--store", str(tmp_path / "records.db")], ["--bus", f"armlink_sim:{arm_path}"]
    passes = [str(swept), str(loaded)]
    assert run(["calibrate", *passes, *store, "--apply", *bus, "--json", "-"]) == 0
    calibration = json.loads(capsys.readouterr().out)
    assert calibration["applied"]
    for gain, (low, high) in zip(calibration["gain"]["estimated"], calibration["gain"]["ci95"], strict=True):
        assert gain == pytest.approx(1.0, abs=0.01)
        assert low < gain < high
    assert run(["identify", *passes, *store, "--json", "-"]) == 0
    gravity = json.loads(capsys.readouterr().out)
    assert all(gravity["identifiable"])
    assert gravity["recursive"] == pytest.approx(gravity["beta"], abs=0.02)
    assert run(["verify", str(arm_path), *bus, *store, "--poses", "4", "--json", "-"]) == 0
    verified = json.loads(capsys.readouterr().out)
    assert verified["passed"]
    assert verified["calibration_record"] == calibration["record"]
    assert verified["gravity_record"] == gravity["record"]


def test_plan_prints_and_moves_nothing(arm_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sweep", str(arm_path), "--plan", "--json", "-"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert [sweep["joint"] for sweep in plan["sweeps"]] == [1, 1, 0, 0]


def test_sweep_needs_a_directory(arm_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sweep", str(arm_path)]) == 2
    assert "--out DIR" in capsys.readouterr().err


def test_a_finished_directory_is_not_swept_over(
    arm_path: Path, swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["sweep", str(arm_path), "--bus", f"armlink_sim:{arm_path}", "--out", str(swept)]) == 2
    assert "not empty" in capsys.readouterr().err


def test_calibrate_without_a_mass_tells_ratios_and_says_why(
    swept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(swept), "--store", str(tmp_path / "records.db"), "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["gain"]["estimated"] == [None, None]
    assert all("reference mass" in each["reason"] for each in answer["not_identifiable"] if each["parameter"] == "gain")
    assert answer["gain_ratio"] == pytest.approx([1.0, 1.0], abs=0.05)
    assert answer["offset"]["estimated"] == pytest.approx([0.0, 0.0], abs=0.1)


def test_identify_without_a_scale_is_refused(swept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["identify", str(swept), "--store", str(tmp_path / "records.db")]) == 1
    assert "--reference-mass" in capsys.readouterr().err


def test_verify_without_a_gravity_record_is_refused(
    arm_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["verify", str(arm_path), "--bus", f"armlink_sim:{arm_path}", "--store", str(tmp_path / "records.db")]
    assert run(command) == 1
    assert "armlink identify makes one" in capsys.readouterr().err


def test_a_directory_that_is_no_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", str(tmp_path)]) == 2
    assert "manifest.json is missing" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["sweep", "calibrate", "identify", "verify"])
def test_help_has_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--help"]) == 0
    assert "Example: armlink" in capsys.readouterr().out
