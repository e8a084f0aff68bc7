"""Model files that cannot be used are refused in one line."""

import pytest

from armlink.errors import BadInput
from armlink.model_file import compile_model, read_model

MODEL = """<mujoco><asset>{mesh}</asset><worldbody>{geom}<body name="arm">
<joint name="hinge" axis="0 1 0"/></body></worldbody></mujoco>"""
ABSENT = " (without the meshes missing.stl, which are not there)"


@pytest.mark.parametrize("absent", [True, False])
def test_a_model_that_does_not_compile_names_the_meshes_that_are_not_there(tmp_path, absent):
    mesh = '<mesh name="shape" file="missing.stl"/>' * absent
    geom = '<geom type="mesh" mesh="shape"/>' * absent
    (tmp_path / "arm.xml").write_text(MODEL.format(mesh=mesh, geom=geom))
    with pytest.raises(BadInput) as refused:
        compile_model(tmp_path / "arm.xml")
    assert f"arm.xml: MuJoCo cannot compile it{ABSENT * absent}: " in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_urdf_whose_prefixes_are_not_declared_is_a_urdf(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><link name="base"/><link name="l1"/><joint name="j1" type="continuous"><parent link="base"/>'
        '<child link="l1"/><drake:limit acceleration="15"/></joint></robot>'
    )
    assert read_model(path).kind == "URDF"
    assert compile_model(path).njnt == 1  # a massless body, which only a URDF may have
