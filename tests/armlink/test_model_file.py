"""Model files that cannot be used are refused in one line."""

import struct
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

from armlink.errors import BadInput
from armlink.model_file import compile_model, expand_xacro, read_model

MODEL = """<mujoco><asset>{mesh}</asset><worldbody>{geom}<body name="arm">
<joint name="hinge" axis="0 1 0"/></body></worldbody></mujoco>"""
ABSENT = " (without 1 mesh not found, such as missing.stl)"


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


URDF_LINK = """<link name="l{k}"><inertial><mass value="{mass}"/>
<inertia ixx="{ixx}" iyy="{iyy}" izz="0.02" ixy="{ixy}" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>"""


def urdf(folder, **changed):
    """One hinge with a link, whose inertial and mesh are as given."""
    link = URDF_LINK.format(**{"k": 1, "mass": 1.0, "ixx": 0.02, "iyy": 0.03, "ixy": 0.0, "mesh": "l1.stl", **changed})
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="base"/>{link}<joint name="j1" type="continuous"><axis xyz="0 1 0"/>'
        '<parent link="base"/><child link="l1"/></joint></robot>'
    )
    return path


def binary_stl(path, corners):
    """A binary STL file of triangles (k, 3, 3) [m]."""
    faces = b"".join(struct.pack("<12fH", *[0.0] * 3, *np.ravel(face), 0) for face in corners)
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + faces)


def test_an_inertia_with_a_negative_moment_is_negligible_and_said(tmp_path):
    path = urdf(tmp_path, ixy=0.09)
    assert read_model(path).unphysical == ("l1",)
    model = compile_model(path)
    assert model.body_mass[model.body("l1").id] == 1.0
    assert (model.body_inertia[model.body("l1").id] > 0.0).all()
    assert read_model(urdf(tmp_path)).unphysical == ()


def test_the_inertia_of_a_body_that_the_arm_does_not_move_is_no_concern(tmp_path):
    found = read_model(urdf(tmp_path, ixy=0.09))
    assert found.unphysical_beyond("j1") == ("l1",)
    assert replace(found, unphysical=("base",)).unphysical_beyond("j1") == ()


def test_a_mesh_in_the_text_form_of_stl_costs_its_shape_alone(tmp_path):
    path = urdf(tmp_path)
    (tmp_path / "l1.stl").write_text("solid l1\nendsolid l1\n")
    found = read_model(path)
    assert [file for file, _ in found.unused_meshes] == ["l1.stl"]
    unread = "in a form that MuJoCo does not read (it reads binary STL, OBJ and MSH)"
    assert found.left_out == f"1 mesh {unread}, such as l1.stl"
    assert compile_model(path).ngeom == 0


def test_an_stl_file_without_faces_costs_its_shape_alone(tmp_path):
    path = urdf(tmp_path)
    binary_stl(tmp_path / "l1.stl", [])
    assert [file for file, _ in read_model(path).unused_meshes] == ["l1.stl"]
    assert compile_model(path).ngeom == 0


SQUARE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n"
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:abab\nsize 12345\n"


@pytest.mark.parametrize("suffix", ["obj", "stl"])
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (POINTER, "not fetched (git lfs pull)"),
        ("", "without volume"),
        (SQUARE, "without volume"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "without volume"),
        ("v 0 0 x\n", "without volume"),
    ],
)
def test_a_mesh_of_no_use_costs_its_shape_alone(tmp_path, suffix, content, reason):
    """A pointer of Git LFS, an empty file, a flat one: whatever the format is."""
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace("l1.stl", f"l1.{suffix}"))
    (tmp_path / f"l1.{suffix}").write_text(content)
    if suffix == "stl" and content != POINTER:
        reason = "in a form that MuJoCo does not read (it reads binary STL, OBJ and MSH)"
    assert read_model(path).unused_meshes == ((f"l1.{suffix}", reason),)
    assert compile_model(path).ngeom == 0


def test_a_flat_stl_costs_its_shape_alone(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    path = urdf(tmp_path)
    binary_stl(tmp_path / "l1.stl", corners[[[0, 1, 2], [1, 3, 2]]])
    assert read_model(path).unused_meshes == (("l1.stl", "without volume"),)
    assert compile_model(path).ngeom == 0


def test_a_mesh_of_hardly_any_volume_is_read_where_the_link_has_an_inertial(tmp_path):
    corners = 1e-6 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    binary_stl(tmp_path / "l1.stl", faces)
    model = compile_model(urdf(tmp_path))
    assert model.ngeom == 1
    assert model.body_mass[model.body("l1").id] == 1.0


def test_what_mujoco_warns_of_is_logged_and_no_file_appears(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    part = tmp_path / "part.xml"
    part.write_text('<mujoco><worldbody><body name="b"><joint name="j"/><geom size="0.1"/></body></worldbody></mujoco>')
    whole = tmp_path / "whole.xml"
    whole.write_text(
        f'<mujoco><asset><model name="part" file="{part}"/></asset><worldbody><frame><attach model="part" body="b" '
        'prefix=""/></frame></worldbody></mujoco>'
    )
    with caplog.at_level("INFO"), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compile_model(whole).njnt == 1
    assert "empty prefix" in caplog.text
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


NUMBERS = """<mujoco><worldbody><body name="arm" pos="0 0 {pos}">
<inertial mass="1" pos="0 0 {centre}" diaginertia="1 1 1"/>
<joint name="hinge" armature="{armature}" range="-1 {range}"/>
<geom size="0.1" pos="{geom} 0 0"/></body></worldbody></mujoco>"""
SOUND = {"pos": "0", "centre": "0", "armature": "0", "range": "1", "geom": "0"}


@pytest.mark.parametrize(
    ("key", "value", "of"),
    [
        ("pos", "inf", "body 'arm': position"),
        ("armature", "inf", "joint 'hinge': armature"),
        ("geom", "inf", "a shape of body 'arm': position"),
        *((key, "nan", "a number is NaN") for key in ("pos", "centre", "range", "geom")),
    ],
)
def test_numbers_that_are_none_are_refused_by_name(tmp_path, key, value, of):
    """MuJoCo takes them; a centre of mass that is NaN it replaces by that of the shapes."""
    (tmp_path / "arm.xml").write_text(NUMBERS.format(**SOUND))
    assert compile_model(tmp_path / "arm.xml").njnt == 1
    (tmp_path / "arm.xml").write_text(NUMBERS.format(**SOUND | {key: value}))
    with pytest.raises(BadInput, match=f"arm.xml: {of}"):
        compile_model(tmp_path / "arm.xml")


XACRO = """<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="length" value="0.4"/>
<xacro:macro name="arm_link" params="name mass"><link name="${name}"><inertial><origin xyz="${length / 2} 0 0"/>
<mass value="${mass}"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
</xacro:macro>
<link name="base"/><xacro:arm_link name="l1" mass="2"/><joint name="j1" type="revolute"><parent link="base"/>
<child link="l1"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="20" velocity="1"/></joint></robot>"""


def test_a_xacro_file_is_expanded(tmp_path, monkeypatch):
    (tmp_path / "two.xacro").write_text(XACRO)
    model = compile_model(expand_xacro(tmp_path / "two.xacro", tmp_path / "two.urdf"))
    assert model.body_mass[model.body("l1").id] == 2.0
    assert model.body_ipos[model.body("l1").id] == pytest.approx([0.2, 0, 0])
    (tmp_path / "two.xacro").write_text(XACRO.replace("0.4", "$(find somewhere)"))
    with pytest.raises(
        BadInput, match=r"xacro cannot expand it: .* need ROS: on a machine with ROS, run xacro .*two.xacro > "
    ):
        expand_xacro(tmp_path / "two.xacro", tmp_path / "two.urdf")
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(
        BadInput, match=r"is a xacro file: install xacro \(pip install xacro\), or expand the file yourself"
    ):
        expand_xacro(tmp_path / "two.xacro", tmp_path / "two.urdf")
