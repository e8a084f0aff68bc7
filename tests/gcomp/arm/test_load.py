"""Arms from URDF and MJCF: torque of the converted arm against Pinocchio and MuJoCo, and what is refused."""

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from published_arms import HALF, IIWA, MJCF, PANDA, UR10, mujoco_torque, urdf

from gcomp.arm.load import load_model, place_chain
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.errors import BadModel
from gcomp.gravity.torque import gravity_torque


def pinocchio_torque(text: str, q: Array) -> Array:
    model = pin.buildModelFromXML(text)
    data = model.createData()
    return np.array([pin.computeGeneralizedGravity(model, data, row) for row in q])


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
    placed = place_chain(path)
    of_link = [[placed.model.body(body).name for body in bodies] for bodies in placed.bodies]
    assert of_link[2] == ["link_3", "cover"]
    assert of_link[-1] == [f"link_{len(rows)}", "tool"]


def test_ur10_converts_to_the_published_denavit_hartenberg_rows(tmp_path: Path) -> None:
    """Universal Robots' own table: a_2 = −0.612, a_3 = −0.5723, d_4 = 0.163941, d_5 = 0.1157 (signs depend on x)."""
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(UR10))
    arm = load_model(path).arm
    assert np.abs(arm.a) == pytest.approx([0, 0.612, 0.5723, 0, 0, 0], abs=1e-9)
    assert np.abs(arm.alpha) == pytest.approx([HALF, 0, 0, HALF, HALF, 0], abs=1e-9)
    assert np.abs(arm.d)[3:5] == pytest.approx([0.163941, 0.1157], abs=1e-9)


@pytest.mark.parametrize("rows", [UR10, PANDA, IIWA], ids=["ur10", "panda", "iiwa"])
@pytest.mark.parametrize("digits", [2, 4, 6, 9])
def test_rounded_angles_leave_the_arm_as_large_as_it_is(rows: list, digits: int, tmp_path: Path, rng) -> None:
    """Angles as published models have them (3.14, 3.1416): the common normal of such axes is up to 27 km away."""
    # one rounding error in every joint, however its angles divide
    rounded = [
        (xyz, tuple(round(angle, digits) + 3 * 10.0**-digits for angle in rpy), *rest) for xyz, rpy, *rest in rows
    ]
    text = urdf(rounded)
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    model, sound = load_model(path), tmp_path / "sound.urdf"
    sound.write_text(urdf(rows))
    assert np.abs(model.arm.span).max() < 1.1 * np.abs(load_model(sound).arm.span).max()
    q = rng.uniform(-2.9, 2.8, (50, len(rows)))
    assert np.abs(gravity_torque(model.arm, model.beta, q) - pinocchio_torque(text, q)).max() < 1e-8
    at_origin, by_point = payload_columns(model.arm)
    placed, point = place_chain(path), np.array([0.03, -0.05, 0.2])
    loaded, last = pin.buildModelFromXML(text), len(rows)
    data = loaded.createData()
    pin.forwardKinematics(loaded, data, placed.reference)
    world = placed.geometry.origins[-1] + placed.geometry.bar[-1] @ point
    loaded.appendBodyToJoint(last, pin.Inertia(2.0, data.oMi[last].actInv(world), np.eye(3)), pin.SE3.Identity())
    data = loaded.createData()
    expected = np.array([pin.computeGeneralizedGravity(loaded, data, row) for row in q])
    held = gravity_torque(model.arm, model.beta + 2.0 * (at_origin + by_point @ point), q)
    assert np.abs(held - expected).max() < 1e-8


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
        legs = mujoco.MjModel.from_xml_path(str(path))
        if np.count_nonzero(legs.body_parentid == legs.body_parentid[legs.jnt_bodyid[0]]) > 1:
            continue  # several chains from one body
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
    with pytest.raises(BadModel, match="joint finger_joint_2 follows another joint"):
        load_model(path)


@pytest.mark.parametrize("value", ["nan", "inf"])
@pytest.mark.parametrize(
    ("sound", "spoilt", "says"),
    [
        ("0 0 -9.81", "{} 0 -9.81", "its gravity"),
        ("0 0 1", "{} 0 1", "joint elbow"),
        ("0 1 0", "{} 1 0", "joint elbow"),
        ("0.5", "{}", "joint elbow"),
        ("2", "{}", "body lower|MuJoCo refuses this file"),
    ],
)
def test_numbers_that_are_none_are_refused_by_name(
    sound: str, spoilt: str, says: str, value: str, tmp_path: Path
) -> None:
    """MuJoCo takes them with a warning, and the gravity of an infinite mass was NaN."""
    inertial = '<inertial pos="0 0 0.1" mass="2" diaginertia="1 1 1"/>'
    joint = '<joint name="elbow" axis="0 1 0" ref="0.5"/>'
    text = f'<body name="lower" pos="0 0 1">{joint}{inertial}</body>'
    text = f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{text}</worldbody></mujoco>'
    path = tmp_path / "arm.xml"
    path.write_text(text)
    assert np.isfinite(load_model(path).beta).all()
    assert text.count(f'"{sound}"') == 1
    path.write_text(text.replace(f'"{sound}"', f'"{spoilt.format(value)}"'))
    with pytest.raises(BadModel, match=says):
        load_model(path)


def test_branches_unknown_tips_and_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a"><joint name="left"/><geom size="0.1"/></body>'
        '<body name="b"><joint name="right"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadModel, match="joint left is on a side branch: name the last body of the chain"):
        load_model(path)
    assert load_model(path, tip="a").arm.names == ("left",)
    with pytest.raises(BadModel, match="no body 'c' for the tip; expected one of a, b"):
        load_model(path, tip="c")
    path.write_text("q_1,q_2\n0,1\n")
    with pytest.raises(BadModel, match="not a URDF or MJCF file"):
        load_model(path)
    path.write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(BadModel, match="the model has no joint, but an arm has at least one"):
        load_model(path)
    path.write_text(
        '<mujoco><worldbody><body name="a"><freejoint name="float"/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(BadModel, match="joint float is free: only revolute"):
        load_model(path)
    with pytest.raises(BadModel, match="not a URDF or MJCF file"):
        load_model(tmp_path / "missing.urdf")


def test_a_urdf_whose_prefixes_are_not_declared_is_read_as_ros_and_mujoco_read_it(tmp_path: Path) -> None:
    """As published ones of the UR5e have it: <drake:acceleration value="…"/> without xmlns:drake."""
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(PANDA))
    plain = load_model(path)
    path.write_text(urdf(PANDA).replace("</link>", '<drake:acceleration value="15"/></link>'))
    assert "drake:" in path.read_text()
    assert np.array_equal(load_model(path).beta, plain.beta)


def test_of_two_arms_on_a_lift_each_holds_what_mujoco_says(tmp_path: Path, rng) -> None:
    """Joints that carry `base` keep the model's position."""

    def limb(side: str, tilt: float) -> str:
        return (
            f'<body name="{side}_upper" euler="{tilt} 20 0"><joint name="{side}_1" axis="0 1 0"/><geom size="0.05" '
            f'mass="2" pos="0.1 0 -0.3"/><body name="{side}_lower" pos="0 0 -0.3"><joint name="{side}_2" axis="1 0 0"/>'
            '<geom size="0.05" mass="1" pos="0 0.1 -0.2"/></body></body>'
        )

    path = tmp_path / "two.xml"
    path.write_text(
        '<mujoco><worldbody><body name="lift"><joint name="lift" type="slide" axis="0 0 1"/>'
        '<geom size="0.1" mass="9"/><body name="torso" '
        'euler="0 0 30"><joint name="waist" axis="1 0 0"/><geom size="0.1" mass="10"/>'
        f"{limb('left', 70)}{limb('right', -70)}</body></body></worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    for base, names in (("torso", ["right_1", "right_2"]), ("lift", ["waist", "right_1", "right_2"])):
        described = load_model(path, base=base, tip="right_lower")
        assert described.arm.names == tuple(names)
        q = rng.uniform(-2, 2, (50, len(names)))
        data, held = mujoco.MjData(model), []
        for pose in q:
            data.qpos[:] = model.qpos0
            data.qpos[[model.joint(name).qposadr[0] for name in names]] = pose
            mujoco.mj_forward(model, data)
            held.append(data.qfrc_bias[[model.joint(name).dofadr[0] for name in names]])
        np.testing.assert_allclose(gravity_torque(described.arm, described.beta, q), held, atol=1e-8)
    with pytest.raises(BadModel, match="joint lift is prismatic: only revolute joints"):
        load_model(path, tip="right_lower")
    with pytest.raises(BadModel, match="body 'left_upper' does not carry 'right_lower'"):
        load_model(path, base="left_upper", tip="right_lower")
