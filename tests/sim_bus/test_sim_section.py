"""The arm file's sim section: what is wrong with it is said in one line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig import one_joint

from armlink.arm_file import load_arm, parse_arm
from armlink.errors import BadInput
from sim_bus.bus.effect_options import parse_drift, parse_effect
from sim_bus.effects.registry import described, effects
from sim_bus.sim_section import sim_section
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

URDF = """<robot name="two"><link name="world"/>
<link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="world"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="50" velocity="2"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint></robot>"""


def test_a_missing_length_an_unknown_effect_and_a_wrong_unit_are_named() -> None:
    with pytest.raises(BadInput, match=r"sensors\.gain has 2 values, expected 1"):
        sim_section(one_joint(sensors={"gain": [1.0, 1.0]}))
    for entry, message in [
        ({"effect": "friction.columb", "joint": "hinge", "torque": 1.0}, "no effect 'friction.columb'"),
        (
            {"effect": "friction.coulomb", "joint": "hinge"},
            r"parameter torque is missing; this effect has torque \[N·m\]",
        ),
        ({"effect": "friction.coulomb", "joint": "hinge", "torque": 1.0, "speed": 2}, "no parameter 'speed'"),
        ({"effect": "friction.coulomb", "torque": 1.0}, "key `joint` is missing"),
        ({"effect": "link.mass_moment", "joint": "hinge", "moment": [1.0]}, "expected 3 numbers"),
        ({"effect": "base.tilt", "joint": "hinge", "angles": [0.1, 0.2]}, "belongs to the whole arm"),
    ]:
        with pytest.raises(BadInput, match=message):
            one_joint(effects=[entry])
    with pytest.raises(BadInput, match="no joint 'knee'"):
        sim_section(one_joint(effects=[{"effect": "friction.coulomb", "joint": "knee", "torque": 1.0}]))
    with pytest.raises(BadInput, match=r"sim\.links\.0\.inertia"):
        one_joint(links=[{"mass": 1.0, "com": [0, 0, 0], "inertia": [0.1, 0.1]}])


def test_an_arm_from_a_model_file_takes_its_inertials_and_stops_from_there(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    controllers = [
        {"name": name, "node": node, "rated_torque": 20.0, "max_torque": 30.0}
        for name, node in (("shoulder", 3), ("elbow", 4))
    ]
    content: dict[str, Any] = {
        "name": "two",
        "kinematics": {"gravity": [0.0, 0.0, -9.81], "model": "arm.urdf"},
        "link": {"joints": controllers},
        "sim": {},
    }
    described = parse_arm(content, tmp_path / "arm.yaml")
    arm = SimulatedArm(described, Truth.of(described))
    expected = [-9.81 * (2 * 0.2 + 0.5), -9.81 * 0.1]
    np.testing.assert_allclose(arm.gravity_torque(np.zeros((1, 2)))[0], expected, atol=1e-6)
    np.testing.assert_allclose(arm.plant.upper, [1.0, 2.0])


def test_torque_ends_where_the_drives_of_the_arm_file_end_not_the_effort_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF.replace('effort="50"', 'effort="3"'))
    controllers = [
        {"name": name, "node": node, "rated_torque": 20.0, "max_torque": 30.0}
        for name, node in (("shoulder", 3), ("elbow", 4))
    ]
    kinematics = {"gravity": [0.0, 0.0, -9.81], "model": "arm.urdf"}
    content = {"name": "two", "kinematics": kinematics, "link": {"joints": controllers}, "sim": {}}
    described = parse_arm(content, tmp_path / "arm.yaml")
    plant = SimulatedArm(described, Truth.of(described)).plant
    plant.set_servo(np.zeros(2), np.zeros(2), np.full(2, 30.0))
    plant.step(np.array([25.0, 20.0]), np.array([25.0, 20.0]), 0.004)
    np.testing.assert_allclose(plant.data.qfrc_actuator, [25.0, 20.0], atol=1e-9)


@pytest.mark.parametrize(("damping", "taken"), [(2.0, 2.0), (20.0, 0.0), (40.0, 0.0)])
def test_damping_that_no_drive_of_the_arm_could_move_is_a_placeholder(
    tmp_path: Path, damping: float, taken: float
) -> None:
    (tmp_path / "arm.urdf").write_text(URDF.replace("</joint>", f'<dynamics damping="{damping}"/></joint>'))
    controllers = [
        {"name": name, "node": node, "rated_torque": 20.0, "max_torque": 30.0, "max_velocity": 1.0}
        for name, node in (("shoulder", 3), ("elbow", 4))
    ]
    kinematics = {"gravity": [0.0, 0.0, -9.81], "model": "arm.urdf"}
    content = {"name": "two", "kinematics": kinematics, "link": {"joints": controllers}, "sim": {}}
    described = parse_arm(content, tmp_path / "arm.yaml")
    plant = SimulatedArm(described, Truth.of(described)).plant
    np.testing.assert_allclose(plant.model.dof_damping, [taken, taken])


@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_stops_of_the_arm_file_come_before_those_of_a_model_file(tmp_path: Path, angle: str) -> None:
    (tmp_path / "arm.xml").write_text(
        f"""<mujoco><compiler angle="{angle}"/><worldbody><body><joint name="hinge" axis="0 1 0" range="-1 1"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""
    )
    controllers = [{"name": "hinge", "node": 3, "rated_torque": 20.0, "max_torque": 30.0}]
    kinematics = {"gravity": [0.0, 0.0, -9.81], "model": "arm.xml", "stops": {"hinge": [-0.5, 0.8]}}
    content = {"name": "one", "kinematics": kinematics, "link": {"joints": controllers}, "sim": {}}
    described = parse_arm(content, tmp_path / "arm.yaml")
    plant = SimulatedArm(described, Truth.of(described)).plant
    np.testing.assert_allclose([plant.lower, plant.upper], [[-0.5], [0.8]])


def test_a_spring_of_a_model_file_is_one_of_the_arm(tmp_path: Path) -> None:
    joint = '<joint name="hinge" axis="0 1 0" range="-1 1" stiffness="10" springref="30"/>'
    body = f'<body>{joint}<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body>'
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    controllers = [{"name": "hinge", "node": 3, "rated_torque": 20.0, "max_torque": 30.0}]
    kinematics = {"gravity": [0.0, 0.0, -9.81], "model": "arm.xml"}
    cable = [{"effect": "transmission.spring", "joint": "hinge", "stiffness": 30.0, "rest": -0.1}]
    content = {"name": "one", "kinematics": kinematics, "link": {"joints": controllers}, "sim": {"effects": cable}}
    described = parse_arm(content, tmp_path / "arm.yaml")
    built = SimulatedArm(described, Truth.of(described)).plant.model
    assert built.jnt_stiffness.tolist() == [40.0]
    assert built.qpos_spring == pytest.approx([(10.0 * np.pi / 6 - 30.0 * 0.1) / 40.0])


def test_drives_take_nothing_from_the_defaults_of_a_model_file(tmp_path: Path) -> None:
    """Of dm_control's manipulator they would have asked for a control range; a gear of 12 would multiply torques."""
    body = """<worldbody><body><joint name="hinge" type="hinge" axis="0 1 0" range="-1 1"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>"""
    defaults = """<default><general ctrllimited="true" gear="12" armature="0.3" damping="4" dyntype="filter"/>
        <joint stiffness="5" damping="0.2" armature="0.1"/></default>"""
    controllers = [{"name": "hinge", "node": 3, "rated_torque": 20.0, "max_torque": 30.0}]
    kinematics = {"gravity": [0.0, 0.0, -9.81], "model": "arm.xml"}
    soft = [{"effect": "transmission.elasticity", "joint": "hinge", "stiffness": 300.0}]
    content = {"name": "one", "kinematics": kinematics, "link": {"joints": controllers}, "sim": {"effects": soft}}
    (tmp_path / "arm.xml").write_text(f"<mujoco>{defaults}{body}</mujoco>")
    described = parse_arm(content, tmp_path / "arm.yaml")
    built = SimulatedArm(described, Truth.of(described)).plant.model
    assert built.actuator_gear[:, 0].tolist() == [1.0]
    assert not built.actuator_ctrllimited.any()
    assert not np.any(built.jnt_stiffness[built.joint("rotor hinge").id])


def test_truth_is_drawn_within_its_ranges_and_frozen() -> None:
    arm = load_arm("sarcos")
    rated = arm.require_link().rated_torques
    drawn = [Truth.draw(arm, seed) for seed in range(200)]
    for truth in drawn:
        assert ((truth.gain >= 0.9) & (truth.gain <= 1.1)).all()
        assert (np.abs(truth.offset) <= 0.05 * rated).all()
        assert ((truth.position_gain >= 0.99) & (truth.position_gain <= 1.01)).all()
        assert (np.abs(truth.attachment[:2]) <= 0.15).all()
        assert truth.attachment[2] == -0.4
    assert np.std([truth.gain for truth in drawn]) == pytest.approx(0.2 / 12**0.5, rel=0.05)
    np.testing.assert_array_equal(Truth.draw(arm, 7).gain, drawn[7].gain)
    with pytest.raises(ValueError, match="read-only"):
        drawn[0].gain[0] = 1.0


def test_effects_and_drifts_of_the_command_line() -> None:
    joints = ("joint_1", "joint_2")
    (entry,) = parse_effect("friction.stribeck:joint_2:0.4,0.05", joints)
    assert (entry.effect, entry.joint) == ("friction.stribeck", "joint_2")
    assert entry.parameters == {"breakaway": 0.4, "velocity": 0.05}
    (payload,) = parse_effect("link.payload::0.5,0.1,0,0.2", joints)
    assert payload.parameters == {"mass": 0.5, "com": [0.1, 0.0, 0.2]}
    (named,) = parse_effect("torque.crosstalk:joint_1:source=joint_2,coefficient=0.1", joints)
    assert named.parameters == {"source": "joint_2", "coefficient": 0.1}
    assert [each.joint for each in parse_effect("friction.coulomb::1.5", joints)] == ["joint_1", "joint_2"]
    drift = parse_drift("joint_1:1.03:0.3@20", joints)
    assert (drift.joint, drift.gain, drift.offset, drift.time) == ("joint_1", 1.03, 0.3, 20.0)
    for wrong in (
        "friction.coulomb",
        "friction.coulomb:joint_9:1",
        "nothing:joint_1:1",
        "friction.coulomb:joint_1:x y",
    ):
        with pytest.raises(BadInput, match="--effect"):
            parse_effect(wrong, joints)
    for wrong in ("friction.coulomb", "friction.coulomb:joint_1:", ":joint_1:1"):
        with pytest.raises(BadInput, match=f"--effect '{wrong}': expected ID:JOINT:"):
            parse_effect(wrong, joints)
    for wrong in ("joint_1:1.03", "joint_1:a:0@1", "knee:1:0@1", "joint_1:0:0@1"):
        with pytest.raises(BadInput, match="--drift"):
            parse_drift(wrong, joints)


def test_the_documentation_lists_every_effect_with_its_parameters_and_units() -> None:
    page = (Path(__file__).parents[2] / "docs" / "simulated-arm.md").read_text(encoding="utf-8")
    for effect in effects().values():
        whose = "joint" if effect.per_joint else "arm"
        assert f"| `{effect.id}` | {whose} | {described(effect)} |" in page
