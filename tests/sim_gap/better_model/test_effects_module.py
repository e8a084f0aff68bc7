"""Model and module that `--out-model` writes: together they do what `sim_bus`'s simulated arm with the effects does."""

import importlib.util
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, Wrong, record

from armlink.arm_file import load_arm
from sim_bus.effects.registry import imperfections
from sim_bus.effects.state import Imperfections
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors
from sim_bus.truth import Truth
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.export import write_model
from sim_gap.better_model.forward_effects import Effects

STEP, STEPS = 5e-4, 1500
ARM = load_arm("sarcos")
J2, J4 = ARM.joint_names[1], ARM.joint_names[3]
PULL = np.array([150.0, 200.0, 60.0, 80.0, 8.0, 8.0, 3.0])
"""Stiffness of the controller [N·m/rad]."""
MOTION = {
    "stribeck": [("friction.stribeck", J2, {"breakaway": 10.0, "velocity": 0.3})],
    "load": [("friction.load", J2, {"coefficient": 0.15})],
    "asymmetric": [("friction.asymmetric", J4, {"ratio": 0.8})],
    "ripple": [("transmission.ripple", J4, {"amplitude": 2.0, "cycles": 9.0, "phase": 0.4})],
    "lag": [("actuator.lag", J2, {"time": 0.05})],
    "delay": [("actuator.delay", J4, {"time": 0.03})],
    "clipped": [("actuator.saturation", J2, {"limit": 6.0})],
    "gain": [("actuator.gain", J4, {"gain": 0.8})],
}
READING = {
    "gain": [("torque.gain", J2, {"gain": 1.1})],
    "offset": [("torque.offset", J2, {"offset": 0.7})],
    "drift": [("torque.drift", J2, {"rate": 0.3})],
    "crosstalk": [("torque.crosstalk", J2, {"coefficient": 0.1, "source": 4.0})],
    "hysteresis": [("torque.hysteresis", J2, {"width": 0.5})],
    "dead band": [("torque.deadband", J2, {"width": 0.8})],
    "clipped": [("torque.saturation", J2, {"limit": 9.0})],
    "late": [("timing.delay", J2, {"delay": 0.02})],
    "angles": [("position.offset", J2, {"offset": 0.03}), ("position.gain", J4, {"gain": 1.02})],
    "ring": [("position.eccentricity", J2, {"amplitude": 0.02, "phase": 0.5})],
}


def plant(entries, coulomb: float = 0.3) -> Plant:
    """sim_bus's arm with these effects; every joint has a little Coulomb friction."""
    friction = [("friction.coulomb", name, {"torque": coulomb}) for name in ARM.joint_names]
    arm = Plant(ARM, state([*friction, *entries]))
    arm.set_servo(np.zeros(arm.n), np.zeros(arm.n), np.full(arm.n, 1e6))
    return arm


def state(entries) -> Imperfections:
    def named(parameters):
        return {k: ARM.joint_names[int(v) - 1] if k == "source" else v for k, v in parameters.items()}

    listed = [SimpleNamespace(effect=e, joint=j, parameters=named(p)) for e, j, p in entries]
    return imperfections(ARM.joint_names, listed)


def asked(arm: Plant, t: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Torques of a soft controller that swings every joint by some tenths of a radian about its start."""
    start = (arm.lower + arm.upper) / 2
    wanted = start + 0.25 * np.sin(2 * np.pi * 0.9 * t + np.arange(arm.n))
    return PULL * (wanted - position) - 0.15 * PULL * velocity + HOLD


def theirs(entries) -> np.ndarray:
    arm, out = plant(entries), []
    for k in range(STEPS):
        torque = asked(arm, k * STEP, arm.position, arm.velocity)
        arm.step(torque, torque, STEP)
        out.append(arm.position)
    return np.array(out)


def ours(entries) -> np.ndarray:
    """The plain arm and the module's effects, in MuJoCo."""
    arm, out = plant([]), []
    model = arm.model
    effects, data = Effects(model, entries, ARM.joint_names), mujoco.MjData(model)
    data.qpos[:] = arm.data.qpos
    model.opt.timestep = STEP
    effects.made(np.zeros(arm.n), -STEP)  # the simulated arm's motors start without torque
    mujoco.set_mjcb_passive(effects.passive)
    try:
        for k in range(STEPS):
            torque = asked(arm, k * STEP, data.qpos[effects.places], data.qvel[effects.dofs])
            data.qfrc_applied[effects.dofs] = effects.made(torque, k * STEP)
            mujoco.mj_step(model, data)
            out.append(data.qpos[effects.places].copy())
    finally:
        mujoco.set_mjcb_passive(None)
    return np.array(out)


HOLD = plant([]).gravity_torque(plant([]).position[None])[0]


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return theirs([])


@pytest.mark.parametrize("name", MOTION)
def test_the_module_moves_the_arm_as_the_simulated_arm_moves(name, plain):
    right, with_module = theirs(MOTION[name]), ours(MOTION[name])
    change = np.abs(right - plain).max()
    assert change > 0.005
    assert np.abs(with_module - right).max() < 0.04 * change


@pytest.mark.parametrize("name", READING)
def test_the_module_reads_as_the_simulated_arms_sensors_read(name):
    arm = plant([])
    sensors = JointSensors(ARM, Truth.of(ARM), state(READING[name]), seed=0)
    sensors.noise = np.zeros(arm.n)
    sensors.torque_step = 1e-9
    effects = Effects(arm.model, READING[name], ARM.joint_names)
    off, off_torque = [], []
    scale = sensors.gain[0], sensors.offset[0]
    assert scale == (1.0, 0.0) or name in ("gain", "offset")
    for k in range(STEPS):
        torque = asked(arm, k * STEP, arm.position, arm.velocity)
        arm.step(torque, torque, STEP)
        q, tau = effects.read(arm.model, arm.data)
        off.append(q - sensors.reading_of(arm.position))
        off_torque.append(tau - sensors.torque(arm.link_torque, arm.data.time))
    assert np.abs(off).max() < 1e-9
    assert np.abs(off_torque).max() < 0.06  # of some 20 N·m; the simulated arm's own step is implicit


@pytest.mark.long
def test_what_is_written_runs_by_itself_and_closes_the_gap(tmp_path):
    (tmp_path / "arm.xml").write_text(THREE)
    wrong = Wrong(coulomb=np.full(3, 0.6), load=np.array([0.0, 0.3, 0.0]), ripple=np.array([0.0, 0.0, 0.5]))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    made = {"seconds": 40, "rate": 100.0, "noise": 0.002, "channels": ("tau_motor",)}
    train, other = (record(model, wrong, seed=s, **made) for s in (1, 2))
    answer = diagnose(tmp_path / "arm.xml", [train], [other])
    lines = write_model(answer.internals.model, answer.internals.estimate, tmp_path / "closed.xml")
    assert any(line.startswith("friction.load joint_2") for line in lines)
    assert "closed_effects.py applies them" in (tmp_path / "closed.xml").read_text()

    spec = importlib.util.spec_from_file_location("closed_effects", tmp_path / "closed_effects.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.MODEL == "closed.xml"
    closed = mujoco.MjModel.from_xml_path(str(tmp_path / "closed.xml"))
    closed.opt.timestep = 0.001
    with_module, without = (_astray(module, closed, other, passive) for passive in (True, False))
    assert with_module < 0.3 * without


def _astray(module, model, recording, passive: bool) -> float:
    """How far 0.5 s of simulation under the recorded torque strays from the recorded motion [rad], RMS of windows."""
    effects, data = module.Effects(model), mujoco.MjData(model)
    speed = np.gradient(recording.position, recording.t, axis=0)
    out = []
    mujoco.set_mjcb_passive(effects.passive if passive else None)
    try:
        for start in range(200, 3000, 400):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = recording.position[start], speed[start]
            for k in range(500):
                row = start + k // 10
                data.qfrc_applied[:] = recording.motor_torque[row]
                mujoco.mj_step(model, data)
            out.append(data.qpos - recording.position[start + 50])
    finally:
        mujoco.set_mjcb_passive(None)
    return float(np.sqrt(np.mean(np.square(out))))


ALL = [
    entry for entries in (MOTION[name] for name in ("stribeck", "load", "asymmetric", "ripple")) for entry in entries
]
ALL += [("law.velocity", J2, {"at": [0.0, 1.0, 3.0], "torque": [0.0, 0.4, 0.6], "directed": True})]
ALL += [("law.position", J4, {"at": [-2.0, 2.0], "torque": [-0.3, 0.3], "directed": False})]


def test_many_arms_at_once_resist_as_one_does_by_the_callback():
    """By what batched simulators have: forces, and the armature and acceleration of the last step."""
    model = plant([]).model
    model.dof_armature[:] = 0.2
    effects, random = Effects(model, ALL, ARM.joint_names), np.random.default_rng(5)
    alone, forces = [], []
    for _ in range(64):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = random.normal(0.0, 0.8, model.nq), random.normal(0.0, 0.5, model.nv)
        data.qfrc_applied[:] = random.normal(0.0, 30.0, model.nv)
        mujoco.mj_forward(model, data)
        made = data.qfrc_applied + data.qfrc_actuator
        carried = made + data.qfrc_passive + data.qfrc_constraint - model.dof_armature * data.qacc
        forces.append([each[effects.dofs] for each in (data.qpos, data.qvel, carried, made - carried)])
        passive = data.qfrc_passive.copy()
        effects.passive(model, data)
        alone.append([model.dof_frictionloss[effects.dofs], (passive - data.qfrc_passive)[effects.dofs]])
    together = effects.resistance(*np.swapaxes(forces, 0, 1))
    np.testing.assert_allclose(np.swapaxes(together, 0, 1), alone, rtol=1e-9, atol=1e-9)
    assert np.ptp(together[0], axis=0).max() > 1.0
    assert np.ptp(together[1], axis=0).max() > 1.0
