"""The plant's gravity against Pinocchio and against the published arm's numbers."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from rig import Rig, one_joint

from armlink.arm_file import ArmFile, load_arm, parse_arm
from sim_bus.effects.registry import imperfections
from sim_bus.physics.plant import Plant
from sim_bus.sim_section import EffectEntry, sim_section

POSES = np.array([[0.0] * 7, [0.1 * i for i in range(1, 8)], [-0.5, 0.9, 1.2, 1.7, -1.1, 0.4, -0.3]])
SARCOS_TORQUE = [
    [0.948627, -24.497532, -10.360341, 21.488805, 0.271737, 6.558966, -0.582714],
    [2.676536, -28.269372, -11.234690, 15.622890, 0.355674, 3.202491, 0.361110],
    [-8.104201, -25.042790, -10.639538, -13.690589, -0.393745, -5.041955, 0.859471],
]


def plant_of(arm: ArmFile, effects: tuple[EffectEntry, ...] = ()) -> Plant:
    return Plant(arm, imperfections(arm.joint_names, effects))


def pinocchio_of(arm: ArmFile) -> pin.Model:
    """The same arm for Pinocchio: placement of joint i+1 in bar frame i is Rx(alpha_i), (a_i, 0, d_i)."""
    model, placement = pin.Model(), pin.SE3.Identity()
    parent = 0
    for row, link in zip(arm.kinematics.joints, sim_section(arm).links, strict=True):
        turn = pin.SE3(pin.utils.rotate("z", row.theta_offset), np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), placement * turn, row.name)
        xx, yy, zz, xy, xz, yz = [*link.inertia, 0.0, 0.0, 0.0][:6]
        about_com = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        model.appendBodyToJoint(parent, pin.Inertia(link.mass, np.array(link.com), about_com), pin.SE3.Identity())
        placement = pin.SE3(pin.utils.rotate("x", row.alpha), np.array([row.a, 0.0, row.d]))
    model.gravity.linear = np.array(arm.kinematics.gravity)
    return model


def random_arm(seed: int) -> ArmFile:
    random = np.random.default_rng(seed)
    n = int(random.integers(3, 8))
    names = [f"axis{i}" for i in range(n)]
    twists = random.choice([0.0, np.pi, np.pi / 2, -np.pi / 2, 0.7, -1.9], n)
    joints = [
        {"name": name, "a": a, "alpha": twist, "d": d, "theta_offset": offset, "lower": -2.0, "upper": 1.5}
        for name, twist, (a, d, offset) in zip(names, twists, random.uniform(-0.5, 0.5, (n, 3)), strict=True)
    ]
    links = [
        {"mass": m, "com": list(c), "inertia": [0.02, 0.03, 0.025, 0.001, -0.002, 0.003]}
        for m, c in zip(random.uniform(0.2, 5.0, n), random.uniform(-0.2, 0.2, (n, 3)), strict=True)
    ]
    controllers = [
        {"name": name, "node": place + 10, "rated_torque": 50.0, "max_torque": 60.0} for place, name in enumerate(names)
    ]
    content = {
        "name": f"random {seed}",
        "kinematics": {"gravity": list(random.uniform(-7, 7, 3)), "joints": joints},
        "link": {"joints": controllers},
        "sim": {"links": links},
    }
    return parse_arm(content, Path("random.yaml"))


def test_sarcos_holds_the_torques_of_the_published_parameters() -> None:
    plant = plant_of(load_arm("sarcos"))
    np.testing.assert_allclose(plant.gravity_torque(POSES), SARCOS_TORQUE, atol=2e-6)


@pytest.mark.parametrize("seed", range(12))
def test_gravity_and_inertia_agree_with_pinocchio_on_random_arms(seed: int) -> None:
    arm = random_arm(seed)
    plant, model = plant_of(arm), pinocchio_of(arm)
    data = model.createData()
    q = np.random.default_rng(seed).uniform(-3, 3, (20, model.nq))
    expected = [pin.computeGeneralizedGravity(model, data, row).copy() for row in q]
    np.testing.assert_allclose(plant.gravity_torque(q), expected, atol=1e-9)
    pin.crba(model, data, q[0])
    expected_inertia = np.triu(data.M) + np.triu(data.M, 1).T
    np.testing.assert_allclose(plant.inertia(q[0]), expected_inertia, atol=1e-9)


def test_a_mass_bolted_on_is_a_point_mass_in_the_last_bar_frame() -> None:
    arm = random_arm(3)
    plant, model = plant_of(arm), pinocchio_of(arm)
    q = np.random.default_rng(0).uniform(-2, 2, (5, model.nq))
    bare = plant.gravity_torque(q)
    point = np.array([0.1, -0.07, 0.2])
    plant.attach_mass(2.0, point)
    model.appendBodyToJoint(model.njoints - 1, pin.Inertia(2.0, point, np.zeros((3, 3))), pin.SE3.Identity())
    data = model.createData()
    expected = [pin.computeGeneralizedGravity(model, data, row).copy() for row in q]
    np.testing.assert_allclose(plant.gravity_torque(q), expected, atol=1e-9)
    plant.detach_mass()
    np.testing.assert_allclose(plant.gravity_torque(q), bare, atol=1e-7)


def test_moved_masses_payload_and_tilt_change_gravity_as_they_should() -> None:
    arm = one_joint()
    q = np.array([[0.0], [0.5]])
    moved = plant_of(arm, (EffectEntry(effect="link.mass_moment", joint="hinge", moment=[0.05, 0.02, 0.0]),))
    expected = 9.81 * ((0.2 + 0.05) * np.cos(q) - 0.02 * np.sin(q))
    np.testing.assert_allclose(moved.gravity_torque(q), expected, atol=1e-9)
    loaded = plant_of(arm, (EffectEntry(effect="link.payload", mass=0.5, com=[0.3, 0.0, 0.1]),))
    np.testing.assert_allclose(loaded.gravity_torque(q), 9.81 * (0.2 + 0.15) * np.cos(q), atol=1e-6)
    tilted = plant_of(arm, (EffectEntry(effect="base.tilt", angles=[0.3, 0.0]),))
    np.testing.assert_allclose(tilted.gravity_torque(q), 9.81 * np.cos(0.3) * 0.2 * np.cos(q), atol=1e-9)


def test_an_arm_at_rest_on_its_brakes_reads_its_gravity() -> None:
    rig = Rig("sarcos")
    rig.arm.advance(0.5)
    np.testing.assert_allclose(rig.arm.plant.link_torque, rig.arm.gravity_torque(rig.arm.plant.position)[0], atol=0.02)
