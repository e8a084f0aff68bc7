"""`armlink identify` of poses: gravity within its bounds, files that others read, and one clear error per bad input."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from drawn_poses import draw, outcome
from real_poses import real_poses

from armlink import cli
from armlink.arm_file import load_arm
from armlink.recording.files import keeps_names, save_recording
from armlink.recording.recording import Recording, take_joints
from calib.arm.kinematics import model_arm, stated_model
from calib.commands.identify_poses import judged_fit
from gcomp.arm.load import inertial_torque
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_regressor, gravity_torque

TWO = """<mujoco><compiler angle="radian"/><worldbody><body pos="0 0 0.3"><joint name="a" axis="0 1 0" range="-2 2"/>
<geom size="0.05" pos="0.2 0 0" mass="{}"/><body pos="0.4 0 0"><joint name="b" axis="0 1 0" range="-2 2"/>
<geom size="0.04" pos="0.15 0 0.02" mass="1"/></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A folder with a model, poses of an arm whose first link is heavier, and some with a mass at its tip."""
    folder = tmp_path_factory.mktemp("poses")
    (folder / "arm.xml").write_text(TWO.format(2))
    (folder / "true.xml").write_text(TWO.format(2.5))
    true = stated_model(str(folder / "true.xml")).placed.arm
    random = np.random.default_rng(1)
    q = random.uniform(-2, 2, (40, 2))
    table(folder / "poses.csv", q, gravity_torque(true.arm, true.beta, q))
    loaded = true.beta + base_parameters(true.arm, [0.0, 1.5], [[0, 0, 0], [0.3, 0.0, 0.0]])
    table(folder / "loaded.csv", q, 1.1 * gravity_torque(true.arm, loaded, q) + 0.5)
    table(folder / "off.csv", q[::-1], 1.1 * gravity_torque(true.arm, true.beta, q[::-1]) + 0.5)
    table(folder / "few.csv", q[:5], gravity_torque(true.arm, true.beta, q[:5]))
    (folder / "still.csv").write_text("q_1,q_2\n0,0\n1,1\n")
    (folder / "three.csv").write_text("q_1,q_2,q_3,tau_1,tau_2,tau_3\n0,0,0,1,1,1\n1,1,1,1,1,1\n")
    np.savetxt(folder / "zero.csv", np.hstack([q, 0 * q]), delimiter=",", header="q_1,q_2,tau_1,tau_2", comments="")
    return folder


def table(path: Path, q: np.ndarray, torque: np.ndarray) -> None:
    """Poses without times, read to a hundredth of a newton-metre."""
    values = np.hstack([q, torque + np.random.default_rng(2).normal(0.0, 0.01, q.shape)])
    np.savetxt(path, values, delimiter=",", header="q_1,q_2,tau_1,tau_2", comments="")


def answered(bench: Path, *options: str, status: int = 0) -> dict:
    arguments = ["identify", *options, "--json", str(bench / "answer.json"), "--store", str(bench / "r.db")]
    assert cli.run([str(bench / each) if (bench / each).is_file() else each for each in arguments]) == status
    return json.loads((bench / "answer.json").read_text())


@pytest.mark.parametrize("seed", [1, 2])
def test_gravity_of_a_drawn_arm_is_within_its_bound_and_pinocchio_agrees(tmp_path, seed):
    found = outcome(draw(seed, tmp_path), seed)
    assert found.inside.all(), (found.error, found.bound)
    assert found.pinocchio < 1e-6
    assert found.judged.passed


def test_a_heavier_link_is_found_and_written(bench, tmp_path):
    better, terms = tmp_path / "better.urdf", tmp_path / "gravity.yaml"
    given = ["poses.csv", "--model", "arm.xml", "--gain-std", "0", "--plan", "2"]
    answer = answered(bench, *given, "--out-model", str(better), "--coefficients", str(terms))
    true = stated_model(str(bench / "true.xml")).placed.arm
    half = 3 * np.array(answer["std"])
    assert np.all(np.abs(np.array(answer["beta"]) - true.beta) < half + 1e-6)
    assert answer["held_out"]["passed"] is True
    assert answer["record"] is None
    assert answer["scale"] is None
    assert np.shape(answer["plan"]["poses"]) == (2, 2)
    assert np.all(np.array(answer["plan"]["gravity_rms95"]) <= answer["gravity_rms95"])
    q = np.random.default_rng(3).uniform(-2, 2, (9, 2))
    written = stated_model(str(better)).placed.arm
    assert gravity_torque(written.arm, written.beta, q) == pytest.approx(
        gravity_torque(true.arm, answer["beta"], q), abs=1e-6
    )
    model = yaml.safe_load(terms.read_text())["/**"]["ros__parameters"]["gravity_model"]
    base = model["base_parameters"]
    assert base["names"] == ["mass_moment_x[a]", "mass_moment_y[a]", "mass_moment_x[b]", "mass_moment_y[b]"]
    assert gravity_regressor(true.arm, q) @ base["values"] == pytest.approx(gravity_torque(true.arm, answer["beta"], q))


def test_a_known_mass_tells_gain_and_offset(bench):
    mass = f"{bench / 'loaded.csv'}=1.5"
    answer = answered(
        bench, "off.csv", "loaded.csv", "--model", "arm.xml", "--gain-std", "0.5", "--reference-mass", mass
    )
    assert answer["gain"]["estimated"] == pytest.approx([1.1, 1.1], abs=0.02)
    assert answer["offset"]["estimated"] == pytest.approx([0.5, 0.5], abs=0.1)
    assert answer["reference_point"][0] == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("suffix", ["csv.gz", "mcap", "parquet"])
def test_a_recording_of_an_arm_that_goes_from_pose_to_pose(bench, tmp_path, suffix):
    true = stated_model(str(bench / "true.xml")).placed.arm
    poses = np.random.default_rng(8).uniform(-1.5, 1.5, (30, 2))
    share = np.clip(np.linspace(0, 2, 60, endpoint=False), 0, 1)[:, None]  # a second of travel, a second of rest
    steps = np.concatenate([a + (b - a) * (3 * share**2 - 2 * share**3) for a, b in itertools.pairwise(poses)])
    speed = np.gradient(steps, 1 / 30, axis=0)
    heavier = stated_model(str(bench / "true.xml")).placed
    torque = gravity_torque(true.arm, true.beta, steps)
    torque += inertial_torque(heavier, steps, speed, np.gradient(speed, 1 / 30, axis=0))
    torque += np.random.default_rng(9).normal(0.0, 0.02, steps.shape)
    swapped = Recording(np.arange(len(steps)) / 30.0, steps[:, ::-1], torque=torque[:, ::-1], names=("b", "a"))
    path = tmp_path / f"run.{suffix}"
    save_recording(swapped if keeps_names(path) else take_joints(swapped, [1, 0]), path)
    answer = answered(bench, str(path), "--model", "arm.xml", "--gain-std", "0")
    assert answer["poses"] > 100
    assert np.abs(np.array(answer["beta"]) - true.beta).max() < 0.03
    assert answer["held_out"]["passed"] is True


def test_without_a_mass_the_scale_is_said_to_be_open(bench):
    answer = answered(bench, "off.csv", "--model", "arm.xml")
    assert answer["scale"] == "a"
    assert any("--reference-mass" in each for each in answer["not_determined"])


def test_held_out_poses_that_the_model_itself_predicts_better_end_with_status_1(bench, tmp_path):
    nominal = stated_model(str(bench / "arm.xml")).placed.arm
    q = np.random.default_rng(5).uniform(-2, 2, (30, 2))
    table(tmp_path / "other.csv", q, gravity_torque(nominal.arm, nominal.beta, q))
    given = ["poses.csv", "--model", "arm.xml", "--gain-std", "0", "--heldout", str(tmp_path / "other.csv")]
    assert answered(bench, *given, status=1)["held_out"]["passed"] is False


def test_poses_beyond_the_limits_of_a_model_in_degrees_are_doubted(bench, tmp_path, capsys):
    answered(bench, "poses.csv", "--model", "arm.xml")
    assert "doubtful" not in capsys.readouterr().out
    (tmp_path / "arm.xml").write_text(TWO.format(2).replace('angle="radian"', ""))
    answered(bench, "poses.csv", "--model", str(tmp_path / "arm.xml"))
    assert "doubtful: the poses of a, b go further than the limits" in capsys.readouterr().out


def test_an_arm_file_gets_a_gravity_record(bench, tmp_path):
    q = np.random.default_rng(6).uniform(0.1, 1.0, (40, 7))
    model = stated_model("sarcos")
    beta = np.random.default_rng(7).normal(0, 1, 14)
    header = ",".join(f"{name}_{i}" for name in ("q", "tau") for i in range(1, 8))
    values = np.hstack([q, gravity_torque(model.arm, beta, q)])
    np.savetxt(tmp_path / "poses.csv", values, delimiter=",", header=header, comments="")
    answer = answered(bench, str(tmp_path / "poses.csv"), "--model", "sarcos", "--gain-std", "0")
    assert cli.run(["history", "sarcos", "--store", str(bench / "r.db"), "--record", answer["record"]]) == 0


def test_the_models_own_moments_are_those_with_the_tool_of_the_arm_file(bench):
    tool = "{mass: 1.5, centre: [0.1, 0, 0]}"
    (bench / "arm.yaml").write_text(f"name: two\nserial: '1'\nkinematics: {{model: arm.xml}}\ntool: {tool}\n")
    exact = model_arm(load_arm(str(bench / "arm.yaml")))
    q = np.random.default_rng(8).uniform(-2, 2, (40, 2))
    table(bench / "carrying.csv", q, gravity_torque(exact.arm, exact.beta, q))
    judged = judged_fit(stated_model(str(bench / "arm.yaml")), [bench / "carrying.csv"], [], {}, 0.0)
    assert np.all(judged.nominal < 0.02)
    assert judged.fit.gravity.beta == pytest.approx(exact.beta, abs=0.01)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("poses.csv --model none.urdf", "there is no model file none.urdf"),
        ("poses.csv --model sarcos --tip hand", "--base and --tip need a URDF or MJCF file"),
        ("none.csv --model arm.xml", "none.csv"),
        ("still.csv --model arm.xml", "no torque"),
        ("three.csv --model arm.xml", "3 joints"),
        ("few.csv --model arm.xml", "at least 12 are needed"),
        ("zero.csv --model arm.xml", "every torque is 0"),
        ("poses.csv poses.csv --model arm.xml", "same data"),
        ("poses.csv --model arm.xml --reference-mass 2", "expected FILE=KG"),
        ("poses.csv --model arm.xml --reference-mass poses.csv=-1", "expected FILE=KG"),
        ("poses.csv --model arm.xml --reference-mass other.csv=1", "not one of the given files of poses"),
        ("poses.csv --model arm.xml --out-model x.obj", ".urdf or .xml"),
        ("poses.csv --model arm.xml --out-model /none/x.xml", "/none"),
        ("poses.csv --model sarcos --out-model x.urdf", "--out-model"),
        ("poses.csv --model arm.xml --effort-is without-gravity", "the efforts do not contain gravity"),
        ("poses.csv --model arm.xml --arm sarcos", "only for sweeps"),
        ("poses.csv --plan 3", "--plan is only for poses"),
        ("poses.csv --gain-std 0", "--gain-std is only for poses"),
    ],
)
def test_a_bad_input_is_one_clear_line(bench, capsys, options, said):
    words = [str(bench / each) if (bench / each).is_file() else each for each in options.split()]
    assert cli.run(["identify", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1


def test_a_mass_in_every_file_is_refused(bench, capsys):
    assert cli.run(
        ["identify", str(bench / "loaded.csv"), "--model", str(bench / "arm.xml"), "--reference-mass",
         f"{bench / 'loaded.csv'}=1.5"]
    ) == 2  # fmt: skip
    assert "without it, too" in capsys.readouterr().err


@pytest.mark.long
def test_three_thousand_real_poses(tmp_path):
    sets = list(real_poses(tmp_path))
    if not sets:
        pytest.skip("no real recordings: set ARMLINK_REALDATA")
    for _, model, poses in sets:
        judged = judged_fit(stated_model(str(model)), [poses], [], {}, None)
        assert len(judged.fit.readings) == 3000
        assert judged.passed
