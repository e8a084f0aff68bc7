"""Models as people have them: grippers, mimic joints, absent meshes, and the arm file of the same model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from armlink.arm_file import load_arm
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm
from sim_gap.model.load import ends_of, joints_between, load_compiled, load_model

ARM4 = Path(__file__).parents[2] / "models" / "arm4.urdf"
"""Four joints, a gripper with a mimic joint, meshes that are not there."""


def torque(model) -> np.ndarray:
    q, v, a = np.random.default_rng(1).uniform(-1, 1, (3, 5, model.n))
    return model.arm.carried(q, v, a) + model.arm.nominal_joint_torque(v, a, np.sign(v))


def test_a_gripper_is_locked_where_the_recording_has_none():
    assert load_model(ARM4, (), 4).n == 4


@pytest.mark.parametrize("gravity", [[0.0, 0.0, -9.81], [9.81, 0.0, 0.0]])
def test_the_arm_file_of_a_model_gives_the_same_torque(gravity, tmp_path):
    """Under the gravity of the arm file: the arm may hang on a wall."""
    document = {"name": "a", "kinematics": {"model": str(ARM4), "gravity": gravity}, "sim": {}}
    arm_file = tmp_path / "a.yaml"
    arm_file.write_text(yaml.safe_dump(document))
    alone = load_model(ARM4, (), 4)
    turned = replace(alone, arm=replace(alone.arm, gravity=np.array(gravity)))
    np.testing.assert_allclose(torque(load_model(arm_file, (), 4)), torque(turned), atol=1e-9)


def test_a_mass_that_comes_from_an_absent_mesh_is_one_line(tmp_path):
    model = tmp_path / "m.xml"
    model.write_text(
        '<mujoco><asset><mesh name="m" file="link.stl"/></asset><worldbody><body name="link"><joint name="j"/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    with pytest.raises(
        BadInput, match=r"mesh link.stl is not found, and body 'link' has its mass from this mesh alone"
    ):
        load_model(model)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("arm.sdf", r"arm.sdf: expected a URDF or MJCF model \(.xml, .mjcf, .urdf\)$"),
        ("arm.urdf.xacro", r"expand it first: xacro .*arm.urdf.xacro > arm.urdf$"),
    ],
)
def test_a_file_of_another_kind_is_one_line(tmp_path, name, says):
    (tmp_path / name).write_text("<sdf/>")
    with pytest.raises(BadInput, match=says):
        load_model(tmp_path / name)


def test_a_model_without_joints_says_so(tmp_path):
    (tmp_path / "arm.urdf").write_text('<robot name="a"><link name="base"/></robot>')
    with pytest.raises(BadInput, match="the model has no hinge or slide"):
        load_model(tmp_path / "arm.urdf", (), 3)


def test_a_file_named_mjcf_is_read_with_its_meshes(tmp_path):
    box = [[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/box.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in box) + "f 1 2 3\nf 2 4 3\nf 5 7 6\nf 6 7 8\nf 1 5 2\nf 2 5 6\n"
        "f 3 4 7\nf 4 8 7\nf 1 3 5\nf 3 7 5\nf 2 6 4\nf 4 6 8\n"
    )  # fmt: skip
    text = (
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" file="box.obj"/></asset><worldbody>'
        '<body name="link"><joint name="j"/><geom type="mesh" mesh="m" density="1000"/></body></worldbody></mujoco>'
    )
    masses = []
    for name in ("arm.xml", "arm.mjcf"):
        (tmp_path / name).write_text(text)
        masses.append(load_model(tmp_path / name).arm.inertial[0, 0])
    assert masses[0] == masses[1] == pytest.approx(8.0)


def arm(side: str, reach: float) -> str:
    """Two hinges on the torso, the second link `reach` long [m]."""
    return (
        f'<body name="{side}_upper" pos="0 {reach} 0"><joint name="{side}_shoulder" axis="0 1 0"/>'
        f'<geom size="0.05" mass="2" pos="0 0 -{reach}"/><body name="{side}_lower" pos="0 0 -{reach}">'
        f'<joint name="{side}_elbow" axis="1 0 0"/><geom size="0.05" mass="1" pos="0 0 -{reach}"/></body></body>'
    )


@pytest.fixture
def two_arms(tmp_path) -> Path:
    """Two arms on a torso that turns and is lifted."""
    path = tmp_path / "two.xml"
    path.write_text(
        '<mujoco><worldbody><body name="lift"><joint name="lift" type="slide" axis="0 0 1"/>'
        '<geom size="0.1" mass="9"/><body name="torso">'
        '<joint name="waist" axis="0 0 1"/><geom size="0.1" mass="10"/>'
        f"{arm('left', 0.3)}{arm('right', 0.4)}</body></body></worldbody></mujoco>"
    )
    return path


def test_which_of_two_arms_is_recorded_is_not_guessed(two_arms):
    with pytest.raises(
        BadInput, match=r"2 arms of 3 joints: choose an arm by its last body .* --tip: left_lower, right_lower"
    ):
        load_model(two_arms, (), 3)


def test_an_arm_is_chosen_by_its_ends(two_arms):
    model = load_compiled(two_arms)
    between = joints_between(model, "torso", "right_lower")
    assert list(between) == ["right_shoulder", "right_elbow"]
    assert list(joints_between(model, None, "left_lower")) == ["lift", "waist", "left_shoulder", "left_elbow"]
    right, left = (
        load_model(two_arms, (), 2, joints_between(model, "torso", tip)) for tip in ("right_lower", "left_lower")
    )
    assert right.arm.names == ("right_shoulder", "right_elbow")
    assert not np.allclose(torque(right), torque(left))


@pytest.mark.parametrize(
    ("base", "tip", "says"),
    [
        ("chest", None, "--base chest: the model has no such body; expected one of lift, torso, left_upper"),
        ("left_upper", "right_lower", "the base body does not carry the tip body"),
        ("right_lower", None, "no joint between these bodies"),
    ],
)
def test_ends_that_are_none_are_one_line(two_arms, base, tip, says):
    with pytest.raises(BadInput, match=says):
        joints_between(load_compiled(two_arms), base, tip)


def test_the_ends_of_an_arm_file_count(two_arms, tmp_path):
    kinematics = {"model": str(two_arms), "base": "torso", "tip": "right_lower"}
    arm_file = tmp_path / "a.yaml"
    arm_file.write_text(yaml.safe_dump({"name": "a", "kinematics": kinematics, "sim": {}}))
    assert ends_of(arm_file) == ("torso", "right_lower")
    assert gcomp_arm(load_arm(arm_file)).names == ("right_shoulder", "right_elbow")
