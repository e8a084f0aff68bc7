"""Transmissions that give, have play, or share motors: against closed forms and a MuJoCo model written out by hand."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rig import UNIT, Rig, one_joint

from armlink.arm_file import ArmFile, load_arm, parse_arm
from armlink.errors import BadInput
from sim_bus.effects.registry import effects, imperfections
from sim_bus.physics.plant import Plant
from sim_bus.physics.transmission import ROTOR_SHARE
from sim_bus.sim_section import EffectEntry

CSP, CST = 8, 10
INERTIA = 0.01 + 0.2**2
"""Of the pendulum about its axis [kg·m²]."""


def effect(name: str, joint: str = "hinge", **parameters: Any) -> dict[str, Any]:
    return {"effect": name, "joint": joint, **parameters}


def turn(rig: Rig, speed: float, seconds: float, place: int = 0) -> None:
    """Turn a joint at constant speed [rad/s] by cyclic position targets."""
    step = np.zeros(len(rig.nodes))
    for _ in range(round(seconds / 0.004)):
        step[place] += speed * 0.004 / UNIT
        whole = np.rint(step)
        step -= whole
        rig.position = rig.position + whole.astype(int)
        rig.cycle()


# ---- elasticity


def test_an_elastic_joint_bends_by_torque_over_stiffness() -> None:
    rig = Rig(one_joint(effects=[effect("transmission.elasticity", stiffness=50.0)]))
    rig.start(CSP)
    rig.run(2.0)
    plant, reading = rig.arm.plant, rig.reading_position[0] * UNIT
    assert plant.link_torque[0] == pytest.approx(9.81 * 0.2 * np.cos(plant.position[0]), abs=2e-3)
    assert reading - plant.position[0] == pytest.approx(plant.link_torque[0] / 50.0, abs=1e-4)


def test_an_elastic_joint_resonates_on_its_locked_motor() -> None:
    rig = Rig(one_joint(effects=[effect("transmission.elasticity", stiffness=200.0)]))
    plant = rig.arm.plant  # the brake holds the motor
    plant.data.qvel[0] = 0.2
    times, angles = np.arange(2000) * 0.001, []
    for _ in times:
        rig.arm.advance(0.001)
        angles.append(plant.position[0])
    swing = np.array(angles) - np.mean(angles)
    crossings = times[1:][(swing[1:] > 0) & (swing[:-1] <= 0)]
    assert np.mean(np.diff(crossings)) == pytest.approx(2 * np.pi / np.sqrt(200.0 / INERTIA), rel=0.01)
    assert plant.motor_velocity[0] == pytest.approx(0.0, abs=1e-3)


def by_hand(stiffness: float, rotor: float, damping: float) -> mujoco.MjModel:
    """The pendulum with its motor on a spring, as MuJoCo's own tendon has it."""
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco><option gravity="0 -9.81 0" timestep="0.0001" integrator="implicitfast"/>
        <worldbody>
          <body><joint name="link" axis="0 0 1"/>
            <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body>
          <body><joint name="rotor" axis="0 0 1" armature="{rotor}"/>
            <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/></body>
        </worldbody>
        <tendon><fixed springlength="0" stiffness="{stiffness}" damping="{damping}">
          <joint joint="rotor" coef="1"/><joint joint="link" coef="-1"/></fixed></tendon>
        <actuator><motor joint="rotor"/></actuator></mujoco>""")


def test_an_elastic_joint_moves_as_two_masses_on_a_spring() -> None:
    stiffness, rotor = 80.0, 0.02
    entries = [
        effect("transmission.elasticity", stiffness=stiffness),
        effect("actuator.rotor_inertia", inertia=rotor),
    ]
    rig = Rig(one_joint(effects=entries, step=0.0002))
    rig.start(CST)
    plant = rig.arm.plant
    model = by_hand(stiffness, rotor, 2 * 0.04 * np.sqrt(stiffness * rotor))
    data = mujoco.MjData(model)
    data.qpos[:] = plant.position[0], plant.motor_position[0]
    data.qvel[:] = plant.velocity[0], plant.motor_velocity[0]
    for step in range(60):
        torque = 196 + round(100 * np.sin(step / 3))
        rig.cycle([torque])
        data.ctrl[0] = torque * 0.01
        mujoco.mj_step(model, data, 40)
        assert plant.position[0] == pytest.approx(data.qpos[0], abs=2e-3)
        assert plant.motor_position[0] == pytest.approx(data.qpos[1], abs=2e-3)
    assert np.ptp(data.qpos) > 0.005


def test_what_is_as_good_as_rigid_is_refused_and_changes_nothing() -> None:
    rig = Rig(one_joint(start=[0.4]))
    with pytest.raises(BadInput, match="nearly rigid"):
        rig.arm.set_effects([EffectEntry(**effect("transmission.elasticity", stiffness=1e9))])
    rig.start(CSP)
    assert rig.arm.plant.position[0] == pytest.approx(0.4, abs=1e-3)
    rig.run(0.1)
    assert rig.arm.effects == ()
    assert rig.arm.plant.motor_position == pytest.approx(rig.arm.plant.position)


# ---- backlash


def test_play_is_crossed_at_torque_reversals() -> None:
    hanging = one_joint(effects=[effect("transmission.backlash", width=0.03), effect("friction.coulomb", torque=0.1)])
    arm = hanging.model_copy(update={"kinematics": hanging.kinematics.model_copy(update={"gravity": (9.81, 0.0, 0.0)})})
    rig = Rig(arm)
    rig.start(CSP)
    for speed, seconds in ((0.3, 1.0), (-0.3, 2.0), (0.3, 2.0)):
        side = np.sign(speed)
        turn(rig, speed, seconds)
        rig.run(0.5)
        plant = rig.arm.plant
        assert np.sign(plant.link_torque[0]) == side
        assert plant.motor_position[0] - plant.position[0] == pytest.approx(side * 0.015, abs=1e-3)


def test_within_the_play_nothing_is_passed_on() -> None:
    arm = one_joint(effects=[effect("transmission.backlash", width=0.1)])
    plant = Plant(arm, imperfections(arm.joint_names, [EffectEntry(**effect("transmission.backlash", width=0.1))]))
    plant.data.qpos[1] = plant.data.qpos[0]  # the motor in the middle of its play, the link falls
    plant.step(np.zeros(1), np.zeros(1), 0.02)
    assert plant.link_torque[0] == 0.0
    assert plant.velocity[0] == pytest.approx(-9.81 * 0.2 / INERTIA * 0.02, rel=1e-3)
    assert plant.motor_velocity[0] == 0.0


# ---- coupling


def two_joints(entries: list[dict[str, Any]], gravity: float = 0.0) -> ArmFile:
    joints = [{"name": name, "a": 0.3, "lower": -2.0, "upper": 2.0} for name in ("upper", "lower")]
    content = {
        "name": "two",
        "kinematics": {"gravity": [0.0, -gravity, 0.0], "joints": joints},
        "link": {
            "joints": [
                {"name": joint["name"], "node": node, "rated_torque": 10.0, "max_torque": 20.0}
                for node, joint in enumerate(joints, 1)
            ]
        },
        "sim": {
            "links": [{"mass": 1.0, "com": [0.15, 0.0, 0.0], "inertia": [0.01, 0.01, 0.01]}] * 2,
            "sensors": {"noise": [0.0, 0.0], "bits": 20},
            "effects": entries,
        },
    }
    return parse_arm(content, Path("two.yaml"))


@pytest.mark.parametrize("soft", [False, True])
def test_a_shared_motor_loads_both_joints_with_its_friction(soft: bool) -> None:
    entries = [
        effect("transmission.coupling", "lower", coefficient=-0.5, source="upper"),
        effect("friction.coulomb", "lower", torque=0.4),
    ]
    if soft:
        entries.append(effect("transmission.elasticity", "lower", stiffness=300.0))
    rig = Rig(two_joints(entries, gravity=9.81))
    rig.start(CSP)
    turn(rig, 0.3, 1.0, place=0)
    plant = rig.arm.plant
    lost = plant.motor_torque - plant.link_torque
    assert plant.motor_velocity == pytest.approx([0.3, 0.0], abs=0.02)
    assert lost == pytest.approx([0.5 * 0.4, -0.4], abs=0.02)


@pytest.mark.parametrize("coefficient", [1.0, -0.7])
def test_a_shared_motor_is_inertia_to_both_joints(coefficient: float) -> None:
    arm = two_joints([])
    bare = Plant(arm, imperfections(arm.joint_names, ()))
    rotor = [EffectEntry(**effect("actuator.rotor_inertia", "lower", inertia=0.05))]
    shared = [*rotor, EffectEntry(**effect("transmission.coupling", "lower", coefficient=coefficient, source="upper"))]
    plant = Plant(arm, imperfections(arm.joint_names, shared))
    torque, turns = np.array([1.0, -0.5]), np.array([coefficient, 1.0])
    for each in (bare, plant):
        each.set_servo(np.zeros(2), np.zeros(2), np.full(2, 9.0))
    expected = np.linalg.solve(bare.inertia(np.zeros(2)) + 0.05 * np.outer(turns, turns), torque)
    plant.step(torque, torque, 0.001)
    np.testing.assert_allclose(plant.data.qacc, expected, rtol=1e-6)
    np.testing.assert_allclose(plant.link_torque, torque - 0.05 * turns * (turns @ expected), rtol=1e-6)


def test_a_joint_is_not_its_own_partner() -> None:
    with pytest.raises(BadInput, match="another joint"):
        Rig(two_joints([effect("transmission.coupling", "lower", coefficient=1.0, source="lower")]))


# ---- together, and while the arm runs


def draw(random: np.random.Generator, arm: ArmFile) -> list[EffectEntry]:
    """Every effect once, on joints drawn at random, of sizes that an arm may have."""
    sizes = {
        "gain": 1.03, "offset": 0.02, "amplitude": 0.02, "cycles": 8.0, "phase": 0.4, "coefficient": 0.03,
        "torque": 0.3, "damping": 0.3, "breakaway": 0.2, "velocity": 0.05, "ratio": 0.2, "moment": [0.01, -0.01, 0.02],
        "inertia": [0.002, 0.002, 0.002], "mass": 0.3, "com": [0.0, 0.02, 0.05], "angles": [0.02, -0.03],
        "rate": 1e-3, "width": 0.005, "limit": 400.0, "delay": 0.008, "stiffness": 2000.0, "rest": 0.1, "time": 0.002,
    }  # fmt: skip
    entries = []
    for each in effects().values():
        joint, source = (str(name) for name in random.choice(arm.joint_names, 2, replace=False))
        values = {p.name: source if p.joint else sizes[p.name] for p in each.parameters}
        if each.id == "actuator.rotor_inertia":
            values["inertia"] = 0.05
        if each.id == "transmission.spring":
            values["stiffness"] = 3.0
        entries.append(EffectEntry(effect=each.id, **({"joint": joint} if each.per_joint else {}), **values))
    return entries


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(3))
def test_all_effects_together_change_while_the_arm_holds(seed: int) -> None:
    random, described = np.random.default_rng(seed), load_arm("sarcos")
    rig = Rig(described)
    rig.start(CSP)
    everything = draw(random, described)
    for entries in ([everything[k] for k in random.permutation(len(everything))[:8]], everything, []):
        rig.arm.set_effects(entries)
        rig.run(0.6)
        assert np.isfinite(rig.arm.plant.link_torque).all()
        np.testing.assert_allclose(rig.reading_position * UNIT, rig.position * UNIT, atol=0.05)
        assert all(rig.status(node) & 0x6F == 0x27 for node in rig.nodes)
    rig.run(0.6)
    np.testing.assert_allclose(rig.arm.plant.motor_position, rig.arm.plant.position)


def test_the_motor_behind_a_spring_has_a_share_of_the_joints_inertia_in_the_middle_of_its_range() -> None:
    arm = load_arm("sarcos")
    names = arm.joint_names
    entry = EffectEntry(**effect("transmission.elasticity", names[0], stiffness=5000.0))
    plant = Plant(arm, imperfections(names, [entry]))
    middle = (plant.lower + plant.upper) / 2
    assert np.abs(middle).max() > 0.1
    assert plant.rotor_inertia[0] == pytest.approx(ROTOR_SHARE * plant.inertia(middle)[0, 0])
    assert np.isinf(plant.rotor_inertia[1:]).all()
