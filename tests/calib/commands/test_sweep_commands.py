"""Commands sweep, calibrate, identify and verify, as a user runs them, on a simulated arm in lock-step."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from sweep_arms import random_arm

from armlink.arm_file import load_arm
from armlink.cli import run
from armlink.link.link import Link
from calib.arm.kinematics import DriveLimits
from calib.dataset import load_data
from calib.install import apply
from calib.records.records import CalibrationRecord
from calib.records.store import RecordStore
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def arm_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A two-joint arm file with short sweeps: few cycles a second, averages no longer than the bounds here ask for."""
    arm = random_arm(31, 2)
    path = tmp_path_factory.mktemp("arm") / "bench.yaml"
    content = arm.model_dump(mode="json", exclude={"path", "sim", "sweep"}, exclude_none=True)
    content["kinematics"].pop("model", None)
    content["sim"] = {
        "links": [link.model_dump(mode="json") for link in arm.sim.links],
        "effects": [{"effect": each.effect, "joint": each.joint, **each.parameters} for each in arm.sim.effects],
    }
    content["link"]["rate"] = 50
    content["sweep"] = {"steps": 5, "acceleration": 10.0, "gain_std": 0.003}
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
    said = capsys.readouterr()
    gravity, where = json.loads(said.out), f"--bus armlink_sim:{arm_path.parent / 'heavier.yaml'}"
    assert said.err.splitlines()[-1].startswith(f"next: armlink verify {arm_path} {where}"), "where it was swept last"
    assert all(gravity["identifiable"])
    assert gravity["recursive"] == pytest.approx(gravity["beta"], abs=0.02)
    assert run(["verify", str(arm_path), *bus, *store, "--poses", "4", "--json", "-"]) == 0
    verified = json.loads(capsys.readouterr().out)
    assert verified["passed"]
    assert verified["calibration_record"] == calibration["record"]
    assert verified["gravity_record"] == gravity["record"]


def test_plan_prints_and_moves_nothing(arm_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sweep", str(arm_path), "--plan", "--picture", str(tmp_path / "plan.html"), "--json", "-"]) == 0
    said = capsys.readouterr()
    assert [sweep["joint"] for sweep in json.loads(said.out)["sweeps"]] == [1, 1, 0, 0]
    legend = next(line for line in said.err.splitlines() if "↔ sweeps" in line)
    signs = "Γ/g is the share of gravity that acts on the joint; ↔ sweeps; ▲ ▼ rests on its upper or lower stop"
    assert legend == signs, "no sign that the table has not"


@pytest.mark.long
def test_a_dry_run_makes_the_whole_sweep_on_the_simulated_arm(
    arm_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No bus is opened: the arm file's own, socketcan:can0, is not there."""
    out = tmp_path / "dry"
    assert run(["sweep", str(arm_path), "--dry-run", "--no-check-stops", "--out", str(out), "--json", "-"]) == 0
    said = capsys.readouterr()
    answer, data = json.loads(said.out), load_data(out)
    assert data.complete
    assert answer["readings"] == len(data.readings)
    mass = answer["recommended_reference_mass"]
    assert mass > 0
    again = f"armlink sweep {arm_path} --dry-run --reference-mass {mass:g} --out {out}-loaded"
    assert said.err.splitlines()[-1] == f"next: {again}"


def test_where_the_model_does_not_hold_nothing_is_written_unless_accepted(
    arm_path: Path, swept: Path, loaded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cable over the second joint pulls with 4 % of rated torque a rad."""
    bent = []
    for whole in (swept, loaded):
        copy = tmp_path / whole.name
        shutil.copytree(whole, copy)
        bent.append(str(copy))
        lines = [json.loads(line) for line in (copy / "readings.jsonl").read_text().splitlines()]
        rated = load_data(copy).manifest.rated_torque[1]
        for line in lines:
            if line["kind"] == "reading":
                line["torque"][1] += 0.04 * rated * line["position"][1]
        (copy / "readings.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    store, bus = ["--store", str(tmp_path / "records.db")], ["--bus", f"armlink_sim:{arm_path}"]
    assert run(["calibrate", *bent, *store, *bus, "--apply"]) == 1
    error = capsys.readouterr().err
    assert "j2: the sensor model does not hold: part of the torque is linear in position" in error
    assert "nothing was written" in error
    assert "--accept j2" in error
    assert run(["calibrate", *bent, *store, *bus, "--apply", "--accept", "j9"]) == 2
    assert "--accept j9: there is no such joint" in capsys.readouterr().err
    assert RecordStore(str(tmp_path / "records.db")).current(CalibrationRecord, load_arm(str(arm_path))) is None
    assert run(["calibrate", *bent, *store, *bus, "--apply", "--accept", "j2", "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["applied"]
    assert answer["doubtful"] == ["j2"]


def test_recalibrate_writes_what_drifted_to_the_controllers(
    arm_path: Path, swept: Path, loaded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensors 4 % up and 3 % down since the sweeps; a new sweep without a mass is enough, and 2100h then holds it."""
    store, passes = ["--store", str(tmp_path / "records.db")], [str(swept), str(loaded)]
    assert run(["calibrate", *passes, *store]) == 0
    assert run(["identify", *passes, *store]) == 0
    arm = load_arm(str(arm_path))
    gain, offset = np.array([1.04, 0.97]), 0.01 * DriveLimits.of(arm).rated
    truth = replace(Truth.of(arm), gain=gain, offset=offset)
    simulated = SimulatedArm(arm, truth, 5)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        again = run_sweep(link, arm, tmp_path / "again")
    monkeypatch.setattr(apply, "open_arm", lambda *_: Link(arm, LockStepBus(arm=simulated)))
    assert run(["recalibrate", str(arm_path), str(again.path), *store, "--apply"]) == 0
    record = RecordStore(str(tmp_path / "records.db")).current(CalibrationRecord, arm)
    assert record is not None
    for node, joint, true in zip(simulated.nodes, record.joints, gain, strict=True):
        held = node.record.active
        assert (held.gain, held.offset) == (np.float32(joint.gain), np.float32(joint.offset))
        assert held.gain == pytest.approx(true, rel=0.01)
    assert [each.offset for each in record.joints] == pytest.approx(
        offset.tolist(), abs=0.003 * DriveLimits.of(arm).rated.max()
    )


def test_history_says_why_a_record_was_not_made_current(
    arm_path: Path, swept: Path, loaded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four times the mass that hung there is stated."""
    other = tmp_path / "other"
    shutil.copytree(loaded, other)
    manifest = json.loads((other / "manifest.json").read_text())
    manifest["reference_mass"] *= 4.0
    (other / "manifest.json").write_text(json.dumps(manifest))
    store = ["--store", str(tmp_path / "records.db")]
    assert run(["calibrate", str(swept), str(other), *store]) == 1
    assert "is stored, but not made current" in capsys.readouterr().err
    assert run(["history", str(arm_path), *store, "--json", "-"]) == 0
    (record,) = json.loads(capsys.readouterr().out)["records"]
    assert record["note"].startswith("not made current: ")
    assert not record["current"]


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
    assert ": armlink sweep " in capsys.readouterr().err


def test_a_directory_that_is_no_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", str(tmp_path)]) == 2
    assert "manifest.json is missing" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["sweep", "calibrate", "identify", "verify"])
def test_help_has_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--help"]) == 0
    assert "Example: armlink" in capsys.readouterr().out


def test_what_the_arm_carries_is_weighed_and_then_declared(
    arm_path: Path, swept: Path, loaded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = ["--store", str(tmp_path / "records.db")]
    for command in ("calibrate", "identify"):
        assert run([command, str(swept), str(loaded), "--arm", str(arm_path), *store]) == 0
    heavier = ["--bus", f"armlink_sim:{loaded.parent / 'heavier.yaml'}"]
    plan = load_data(swept).plan
    assert plan is not None
    answer = tmp_path / "weigh.json"
    assert run(["weigh", str(arm_path), *heavier, *store, "--yes", "--poses", "6", "--json", str(answer)]) == 0
    found = json.loads(answer.read_text(encoding="utf-8"))
    assert found["schema"] == "armlink.weigh/1"
    assert found["mass_ci95"][0] < plan.reference_mass < found["mass_ci95"][1]
    for (low, high), true in zip(found["centre_ci95"], (0.1, 0.12, 0.05), strict=True):
        assert low is None or low - 1e-3 < true < high + 1e-3
    tool = f"{plan.reference_mass},0.1,0.12,0.05"
    capsys.readouterr()
    assert run(["verify", str(arm_path), *heavier, *store, "--yes", "--poses", "4"]) == 1
    assert run(["verify", str(arm_path), *heavier, *store, "--yes", "--poses", "4", "--tool", tool]) == 0


def test_weigh_without_records_says_how_to_make_them(
    arm_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["weigh", str(arm_path), "--store", str(tmp_path / "none.db"), "--yes"]) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert "no gravity record yet" in error


@pytest.mark.parametrize("options", [["--poses", "3"], ["--seed", "-1"], ["--poses", "many"]])
def test_weigh_refuses_options_out_of_range(arm_path: Path, capsys: pytest.CaptureFixture[str], options: list) -> None:
    assert run(["weigh", str(arm_path), *options]) == 2
    assert options[0] in capsys.readouterr().err
