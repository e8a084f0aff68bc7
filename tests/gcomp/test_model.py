"""Arms from URDF and MJCF: torque of the converted arm against Pinocchio and MuJoCo, and what is refused."""

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from gcomp.arrays import Array
from gcomp.errors import BadModel
from gcomp.gravity import gravity_torque
from gcomp.model import load_model

HALF = np.pi / 2
UR10 = [  # xyz, rpy, axis, mass, com: as in the UR description, shoulder, upper arm and forearm axes parallel
    ((0, 0, 0.1273), (0, 0, 0), (0, 0, 1), 7.778, (0, 0, 0.01)),
    ((0, 0.220941, 0), (0, HALF, 0), (0, 1, 0), 12.93, (0, 0, 0.306)),
    ((0, -0.1719, 0.612), (0, 0, 0), (0, 1, 0), 3.87, (0, 0.01, 0.2862)),
    ((0, 0, 0.5723), (0, HALF, 0), (0, 1, 0), 1.96, (0, 0.1149, 0)),
    ((0, 0.1149, 0), (0, 0, 0), (0, 0, 1), 1.96, (0.01, 0, 0.1157)),
    ((0, 0, 0.1157), (0, 0, 0), (0, 1, 0), 0.202, (0, 0.0922, 0.005)),
]
PANDA = [
    ((0, 0, 0.333), (0, 0, 0), (0, 0, 1), 4.97, (0.0039, 0.0021, -0.048)),
    ((0, 0, 0), (-HALF, 0, 0), (0, 0, 1), 0.647, (-0.0031, -0.029, 0.0035)),
    ((0, -0.316, 0), (HALF, 0, 0), (0, 0, 1), 3.23, (0.0275, 0.0393, -0.0665)),
    ((0.0825, 0, 0), (HALF, 0, 0), (0, 0, 1), 3.59, (-0.0532, 0.1044, 0.0275)),
    ((-0.0825, 0.384, 0), (-HALF, 0, 0), (0, 0, 1), 1.23, (-0.0114, 0.0412, -0.0385)),
    ((0, 0, 0), (HALF, 0, 0), (0, 0, 1), 1.67, (0.0601, -0.0144, -0.0105)),
    ((0.088, 0, 0), (HALF, 0, 0), (0, 0, 1), 0.735, (0.0105, -0.0043, 0.0616)),
]
IIWA = [
    ((0, 0, 0.1475), (0, 0, 0), (0, 0, 1), 3.95, (0, -0.03, 0.12)),
    ((0, -0.0105, 0.1925), (-HALF, 0, 0), (0, 0, -1), 4.5, (0.0003, 0.059, 0.042)),
    ((0, 0.0105, -0.2075), (1.5708, 3.1416, 0), (0, 0, 1), 2.46, (0, 0.03, 0.13)),  # rounded as such files are
    ((0, -0.0105, 0.1925), (1.5708, 0, 0), (0, 0, 1), 2.61, (0, 0.067, 0.034)),
    ((0, 0.0105, -0.2075), (-1.5708, 3.1416, 0), (0, 0, 1), 3.41, (0.0001, 0.021, 0.076)),
    ((0, -0.0707, 0.1925), (1.5708, 0, 0), (0.6, 0, 0.8), 3.39, (0, 0.0006, 0.0004)),
    ((0, 0.0707, -0.091), (-1.5708, 3.1416, 0), (0, 0, 1), 0.354, (0, 0, 0.02)),
]


def urdf(rows: list, base_rpy: tuple[float, ...] = (0, 0, 0)) -> str:
    """A URDF with a massless first link, a fixed joint in the middle of the chain and a tool welded to its end."""

    def text(values: tuple[float, ...]) -> str:
        return " ".join(map(repr, values))

    def link(name: str, mass: float = 0.0, com: tuple[float, ...] = (0, 0, 0)) -> str:
        inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
        shape = '<visual><geometry><mesh filename="package://nowhere/missing.stl"/></geometry></visual>'
        inner = f'<inertial><origin xyz="{text(com)}"/><mass value="{mass}"/>{inertia}</inertial>{shape}'
        return f'<link name="{name}">{inner if mass else ""}</link>'

    def joint(name: str, kind: str, parent: str, child: str, xyz: tuple, rpy: tuple, axis: tuple = (0, 0, 1)) -> str:
        return (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="{text(axis)}"/>'
            '<limit lower="-2.9" upper="2.8" effort="100" velocity="1"/></joint>'
        )

    parts = [link("world"), link("base", 4.0), joint("mount", "fixed", "world", "base", (0.1, 0.2, 0.3), base_rpy)]
    parent = "base"
    for i, (xyz, rpy, axis, mass, com) in enumerate(rows, start=1):
        parts += [link(f"link_{i}", mass, com), joint(f"joint_{i}", "revolute", parent, f"link_{i}", xyz, rpy, axis)]
        parent = f"link_{i}"
        if i == 3:
            parts += [link("cover", 0.3, (0.02, 0.03, 0.04))]
            parts += [joint("screw", "fixed", parent, "cover", (0.05, 0, 0.1), (0.3, -0.2, 0.1))]
    parts += [
        link("tool", 0.7, (0.01, -0.02, 0.05)),
        joint("weld", "fixed", parent, "tool", (0, 0, 0.1), (0.1, 0.2, 0)),
    ]
    return '<?xml version="1.0"?><robot name="arm">' + "".join(parts) + "</robot>"


def pinocchio_torque(text: str, q: Array) -> Array:
    model = pin.buildModelFromXML(text)
    data = model.createData()
    return np.array([pin.computeGeneralizedGravity(model, data, row) for row in q])


def mujoco_torque(path: Path, q: Array) -> Array:
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rows = mujoco.MjData(model), []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        rows.append(data.qfrc_bias.copy())
    return np.array(rows)


@pytest.mark.parametrize("rows", [UR10, PANDA, IIWA], ids=["ur10", "panda", "iiwa"])
@pytest.mark.parametrize("base_rpy", [(0, 0, 0), (0.4, -1.1, 2.0), (np.pi, 0, 0)])
def test_urdf_arms_hold_what_pinocchio_says(rows: list, base_rpy: tuple, tmp_path: Path, rng) -> None:
    text = urdf(rows, base_rpy)
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    model = load_model(path)
    q = rng.uniform(-2.9, 2.8, (100, len(rows)))
    assert np.abs(gravity_torque(model.arm, model.beta, q) - pinocchio_torque(text, q)).max() < 1e-8
    assert model.arm.names == tuple(f"joint_{i}" for i in range(1, len(rows) + 1))
    assert model.arm.lower == pytest.approx(np.full(len(rows), -2.9))
    assert model.bodies[2] == ("link_3", "cover")
    assert model.bodies[-1] == (f"link_{len(rows)}", "tool")


def test_ur10_converts_to_the_published_denavit_hartenberg_rows(tmp_path: Path) -> None:
    """Universal Robots' own table: a_2 = −0.612, a_3 = −0.5723, d_4 = 0.163941, d_5 = 0.1157 (signs depend on x)."""
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(UR10))
    arm = load_model(path).arm
    assert np.abs(arm.a) == pytest.approx([0, 0.612, 0.5723, 0, 0, 0], abs=1e-9)
    assert np.abs(arm.alpha) == pytest.approx([HALF, 0, 0, HALF, HALF, 0], abs=1e-9)
    assert np.abs(arm.d)[3:5] == pytest.approx([0.163941, 0.1157], abs=1e-9)


MJCF = """<mujoco><compiler angle="degree" eulerseq="zyx"/><option gravity="1 2 -9"/>
<default><default class="j"><joint type="hinge" axis="0 1 1" range="-100 120"/></default></default><worldbody>
<body name="base" euler="10 20 30"><geom size="0.1" mass="3"/>
<body name="a" pos="0.1 0.2 0.3" euler="15 25 35"><joint name="j1" class="j" pos="0.01 0.02 0.03" ref="20"/>
 <geom type="capsule" fromto="0 0 0 0.3 0.1 0.2" size="0.04"/>
 <body name="b" pos="0.3 0 0"><joint name="j2" class="j" axis="0 1 1"/><joint name="j3" class="j" axis="1 0 0"/>
  <inertial pos="0.01 0.02 0.1" mass="2" diaginertia="0.01 0.01 0.01"/>
  <body name="lump" pos="0 0 0.1"><geom size="0.03" mass="0.4" pos="0.1 0 0"/></body>
  <body name="c" pos="0 0.2 0.1" quat="0.8 0.1 0.2 0.5"><joint name="j4" class="j" limited="false"/>
   <geom type="box" size="0.05 0.02 0.1" pos="0 0.05 0" mass="1.2"/></body></body></body></body></worldbody></mujoco>"""


def test_mjcf_of_every_kind_holds_what_mujoco_says(tmp_path: Path, rng) -> None:
    """Degrees, reference angles, anchors off the frame, two joints in a body, welded bodies, masses from shapes."""
    path = tmp_path / "arm.xml"
    path.write_text(MJCF)
    model = load_model(path)
    q = rng.uniform(-2, 2, (100, 4))
    assert np.abs(gravity_torque(model.arm, model.beta, q) - mujoco_torque(path, q)).max() < 1e-8
    assert model.arm.lower[:3] == pytest.approx(np.deg2rad([-100, -100, -100]))
    assert model.arm.upper[3] == np.inf


def test_real_arms_models_hold_what_mujoco_says(realdata: Path, rng) -> None:
    for path in sorted(realdata.glob("*/sim.xml")):
        model = load_model(path)
        q = rng.uniform(-3, 3, (50, model.arm.n))
        assert np.abs(gravity_torque(model.arm, model.beta, q) - mujoco_torque(path, q)).max() < 1e-8


@pytest.mark.parametrize("angle", [1e-4, 1e-6, 3e-7, 1e-8, 1e-10, 1e-14])
def test_axes_a_hair_from_parallel_lose_nothing(angle: float, tmp_path: Path, rng) -> None:
    """The common normal of such axes may lie kilometres away; torque stays right to 1e-8 N·m."""
    rows = [UR10[0], *[((0, 0.1, 0.5), (angle, 0.7 * angle, 0), (0, 1, 0), 3.0, (0.1, 0.02, 0.2))] * 3, UR10[5]]
    text = urdf(rows)
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    model = load_model(path)
    q = rng.uniform(-2.8, 2.8, (50, len(rows)))
    assert np.abs(gravity_torque(model.arm, model.beta, q) - pinocchio_torque(text, q)).max() < 1e-8


def test_gravity_given_in_the_models_frame_replaces_its_own(tmp_path: Path, rng) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(PANDA, (0.1, 0.2, 0.3)))
    model = load_model(path, gravity=(3.0, 4.0, -5.0))
    reference = pin.buildModelFromXML(path.read_text())
    reference.gravity.linear = np.array([3.0, 4.0, -5.0])
    q = rng.uniform(-2, 2, 7)
    expected = pin.computeGeneralizedGravity(reference, reference.createData(), q)
    assert gravity_torque(model.arm, model.beta, q) == pytest.approx(expected, abs=1e-8)


def fingers(text: str, extra: str = "") -> str:
    """The arm with two prismatic fingers on its last link."""
    parts = "".join(
        f'<link name="finger_{side}"/><joint name="finger_joint_{side}" type="prismatic"><parent link="tool"/>'
        f'<child link="finger_{side}"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="1" velocity="1"/>'
        f"{extra if side == 2 else ''}</joint>"
        for side in (1, 2)
    )
    return text.replace("</robot>", parts + "</robot>")


def test_prismatic_and_mimic_joints_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(fingers(urdf(PANDA)))
    with pytest.raises(BadModel, match="joint finger_joint_1 is prismatic: only revolute joints"):
        load_model(path)
    assert load_model(path, tip="link_7").arm.n == 7
    path.write_text(fingers(urdf(PANDA), '<mimic joint="finger_joint_1"/>'))
    with pytest.raises(BadModel, match="joint finger_joint_2 mimics another"):
        load_model(path)


def test_branches_unknown_tips_and_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><joint name="left"/><geom size="0.1"/></body>'
        '<body name="b"><joint name="right"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadModel, match="joint left branches off the chain: say with tip"):
        load_model(path)
    assert load_model(path, tip="a").arm.names == ("left",)
    with pytest.raises(BadModel, match="no body 'c' for tip; there are a, b"):
        load_model(path, tip="c")
    path.write_text("q_1,q_2\n0,1\n")
    with pytest.raises(BadModel, match="not a URDF or MJCF file"):
        load_model(path)
    path.write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(BadModel, match="no joint: an arm has at least one"):
        load_model(path)
    path.write_text(
        '<mujoco><worldbody><body name="a"><freejoint name="float"/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadModel, match="joint float is free: only revolute"):
        load_model(path)
    with pytest.raises(BadModel, match="not a URDF or MJCF file"):
        load_model(tmp_path / "missing.urdf")
