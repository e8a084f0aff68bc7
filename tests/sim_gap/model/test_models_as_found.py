"""Models as people have them: grippers, mimic joints, absent meshes, and the arm file of the same model."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from armlink.errors import BadInput
from sim_gap.model.load import load_model

ARM4 = Path(__file__).parents[2] / "models" / "arm4.urdf"
"""Four joints, a gripper with a mimic joint, meshes that are not there."""


def torque(model) -> np.ndarray:
    q, v, a = np.random.default_rng(1).uniform(-1, 1, (3, 5, model.n))
    return model.arm.carried(q, v, a) + model.arm.nominal_joint_torque(v, a, np.sign(v))


def test_a_gripper_is_locked_where_the_recording_has_none():
    assert load_model(ARM4, (), 4).n == 4


def test_the_arm_file_of_a_model_gives_the_same_torque(tmp_path):
    document = {"name": "a", "kinematics": {"model": str(ARM4)}, "sim": {}}
    arm_file = tmp_path / "a.yaml"
    arm_file.write_text(yaml.safe_dump(document))
    np.testing.assert_allclose(torque(load_model(arm_file, (), 4)), torque(load_model(ARM4, (), 4)), atol=1e-9)


def test_a_mass_that_comes_from_an_absent_mesh_is_one_line(tmp_path):
    model = tmp_path / "m.xml"
    model.write_text(
        '<mujoco><asset><mesh name="m" file="link.stl"/></asset><worldbody><body name="link"><joint name="j"/>'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadInput, match=r"mesh link.stl is not there, and body 'link' has its mass from it alone"):
        load_model(model)
