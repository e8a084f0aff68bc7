"""Joints within the chain that other means than the arm's drives hold: calibrated around, their load counted."""

import contextlib
import io
import json
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import yaml

from armlink.arm_file import load_arm
from armlink.cli import run
from armlink.errors import BadInput
from armlink.model_file import compile_model
from calib.arm.kinematics import model_arm
from calib.plan.collisions import Geometry
from gcomp.gravity.torque import gravity_torque
from sim_bus.effects.state import Imperfections
from sim_bus.physics.mjcf import build_model
from sim_gap.model.load import read_spec

LIFT = """<robot name="lift">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0.01 0.02"/><mass value="3"/><inertia ixx="0.01" iyy="0.02" izz="0.02"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="slide"><inertial><origin xyz="0 0.05 0.1"/><mass value="1.5"/><inertia ixx="0.004" iyy="0.004"
    izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0.15 0 0"/><mass value="2"/><inertia ixx="0.004" iyy="0.01" izz="0.01"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="hand"><inertial><origin xyz="0.05 0.02 0"/><mass value="0.6"/><inertia ixx="0.001" iyy="0.001"
    izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin rpy="1.2 0.3 0"/>
    <axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5" effort="60" velocity="2"/></joint>
  <joint name="lift" type="prismatic"><parent link="upper"/><child link="slide"/><origin xyz="0.4 0 0" rpy="0 0.4 0.2"/>
    <axis xyz="0.6 0 0.8"/><limit lower="0" upper="0.3" effort="200" velocity="0.2"/></joint>
  <joint name="elbow" type="revolute"><parent link="slide"/><child link="fore"/><origin xyz="0 0 0.2" rpy="0.4 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1.6" upper="1.2" effort="30" velocity="2"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="hand"/><origin xyz="0.3 0 0" rpy="1.5 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1.4" upper="1.4" effort="8" velocity="2"/></joint>
</robot>"""
JOINTS = ("shoulder", "elbow", "wrist")


class Done(NamedTuple):
    """What a command answered."""

    returncode: int
    stdout: str
    stderr: str


def run_armlink(*words: str) -> Done:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as error:
        status = run([*words])
    return Done(status, out.getvalue(), error.getvalue())


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "lift.urdf"
    path.write_text(LIFT)
    return path


def potential_energy(model: "mujoco.MjModel", position: dict[str, float]) -> float:
    """Of MuJoCo's own model with nothing locked [J]."""
    data = mujoco.MjData(model)
    for name, value in position.items():
        data.joint(name).qpos[:] = value
    mujoco.mj_kinematics(model, data)
    return -float(model.body_mass @ (data.xipos @ model.opt.gravity))


@pytest.mark.parametrize(("joint", "at"), [("lift", 0.17), ("elbow", -0.9)])
def test_gravity_is_that_of_the_held_pose(model: Path, tmp_path: Path, joint: str, at: float) -> None:
    locked = {"lift": 0.0, joint: at}
    options = [word for name, position in locked.items() for word in ("--lock", f"{name}:{position}")]
    made = run_armlink("new", str(model), "--out", str(tmp_path / "arm.yaml"), *options)
    assert made.returncode == 0, made.stderr
    arm = load_arm(str(tmp_path / "arm.yaml"))
    names = tuple(name for name in JOINTS if name != joint)
    assert arm.joint_names == names
    assert arm.kinematics.locked == locked

    free, random = compile_model(model), np.random.default_rng(5)
    known = model_arm(arm)
    poses = random.uniform(-1.2, 1.2, (8, len(names)))
    expected = np.empty(poses.shape)
    for row, pose in enumerate(poses):
        for column in range(len(names)):
            step = 1e-5 * np.eye(len(names))[column]
            up, down = (
                potential_energy(free, locked | dict(zip(names, pose + way * step, strict=True))) for way in (1, -1)
            )
            expected[row, column] = (up - down) / 2e-5
    torque = gravity_torque(known.arm, known.beta, poses)
    np.testing.assert_allclose(torque, expected, atol=1e-6)

    for compiled in (build_model(arm, Imperfections(names)).model, read_spec(arm.path).compile()):
        data = mujoco.MjData(compiled)
        for name, value in zip(names, poses[0], strict=True):
            data.joint(name).qpos[:] = value
        mujoco.mj_forward(compiled, data)
        bias = np.array([data.joint(name).qfrc_bias[0] for name in names])
        np.testing.assert_allclose(bias, expected[0], atol=1e-5)
    assert Geometry(arm).model.body("hand").id > 0


def test_the_joint_in_the_way_is_named_with_the_way_round_it(model: Path, tmp_path: Path) -> None:
    done = run_armlink("new", str(model), "--out", str(tmp_path / "arm.yaml"))
    assert done.returncode == 2
    assert "joint lift is prismatic" in done.stderr
    assert "--lock lift:POSITION" in done.stderr


@pytest.mark.parametrize(
    ("lock", "said"),
    [
        ("lift:0.5", "joint 'lift' cannot be locked at 0.5: its range is 0 to 0.3"),
        ("lift:high", "--lock lift:high: expected JOINT:POSITION in rad or m, such as lift:0.2"),
        ("left:0.1", "--lock left: there is no such joint in"),
    ],
)
def test_a_lock_that_cannot_be_is_one_line(model: Path, tmp_path: Path, lock: str, said: str) -> None:
    done = run_armlink("new", str(model), "--out", str(tmp_path / "arm.yaml"), "--lock", lock)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())
    assert not (tmp_path / "arm.yaml").exists()


@pytest.mark.long
def test_doctor_and_a_rehearsal_take_it(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "arm.yaml"
    assert run_armlink("new", str(model), "--out", str(out), "--lock", "lift:0.1").returncode == 0
    doctor = run_armlink("doctor", str(out), "--offline", "--json", "-")
    assert not [found for found in json.loads(doctor.stdout)["findings"] if found["level"] == "error"]
    content = yaml.safe_load(out.read_text())
    content["link"]["rate"] = 50
    content["sweep"] = {"steps": 5, "poses": 1, "gain_std": 0.01, "acceleration": 10.0}
    out.write_text(yaml.safe_dump(content))
    swept = run_armlink("sweep", str(out), "--dry-run", "--out", str(tmp_path / "unloaded"))
    assert swept.returncode == 0, swept.stderr


def test_rows_have_nothing_to_lock(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(
        "name: a\nkinematics:\n  joints: [{name: j, a: 0.2, alpha: 0, d: 0, lower: -1, upper: 1}]\n  locked: {j: 0.1}\n"
    )
    with pytest.raises(BadInput, match="`locked` belongs to a model"):
        load_arm(str(path))
