import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from sim_gap.model.load import load_model
from sim_gap.model.solver_friction import creep_speeds
from sim_gap.position_gap.controller import nominal_controller, nominal_point
from sim_gap.position_gap.fit import LoopFit, batch, evaluate, jacobian
from sim_gap.position_gap.judge import joint_rms
from sim_gap.position_gap.parameters import Scales, step_parameter
from sim_gap.position_gap.rivals import _like
from sim_gap.position_gap.simulate import simulate
from sim_gap.position_gap.training.export import POSITION_INPUT
from sim_gap.position_gap.windows import windows_of

TEXT = model_text(kp=15.0, friction=0.2)


def _windows(text: str = TEXT):
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = windows_of(sim.arm, [record(TEXT, 1, 20.0)], ["run"])
    return data, nominal_point(data, nominal_controller(sim))


FADING = "stribeck", "stribeck_velocity"


def test_agrees_with_mujoco_on_a_servo_with_friction() -> None:
    data, point = _windows()
    found = evaluate(data, LoopFit(point, ((), ())))
    moved = np.sqrt(np.mean((data.command - data.recorded) ** 2, axis=(0, 2)))
    assert (joint_rms(data, found.rms) < np.maximum(0.03 * moved, 1.5e-3)).all()


def test_agrees_with_mujoco_on_friction_under_which_a_joint_creeps() -> None:
    """MuJoCo's usual solver parameters, and the half step by which it is early."""
    text = model_text(kp=15.0, friction=0.2, creeps=True)
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = windows_of(sim.arm, [record(text, 1, 20.0)], ["run"])
    early = np.full(2, -0.5 * sim.mujoco_model.opt.timestep)
    point = {**nominal_point(data, nominal_controller(sim)), "delay": early}
    speeds = creep_speeds(sim.mujoco_model, [0, 1])
    creeping, resting = (
        joint_rms(data, evaluate(data, LoopFit({**point, "creep": each}, ((), ()))).rms)
        for each in (speeds, 0.0 * speeds)
    )
    assert (creeping < 6e-4).all()
    assert (creeping < 0.8 * resting).all()


def test_the_step_shows_neither_as_a_lead_nor_as_inertia() -> None:
    """A step of 5 ms moves a strongly damped servo as one of 1 ms does: to a small part of its way in half a step."""
    text = model_text(kp=60.0, friction=0.0, damping=3.0)
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    recording = record(text, 1, 7.8)
    coarse, fine = (windows_of(sim.arm, [recording], ["run"], step) for step in (0.005, 0.001))
    slow, fast = (simulate(each, batch([nominal_point(each, nominal_controller(sim))])) for each in (coarse, fine))
    apart = np.sqrt(np.mean((slow - fast) ** 2, axis=(0, 1, 3)))
    way = 0.5 * coarse.dt * np.sqrt(np.mean(coarse.v**2, axis=(0, 2)))
    assert (apart < 0.1 * way).all()


@pytest.mark.parametrize(
    ("rotor", "breakaway"),
    [
        (0.02, (0.4, 0.1)),
        (0.002, (0.4, 0.1)),
        (0.02, (0.4, 0.02)),
        (0.02, (0.15, 0.05)),
        (0.002, (0.15, 0.05)),
    ],
)
def test_agrees_with_mujoco_on_friction_that_fades_with_the_velocity(rotor: float, breakaway) -> None:
    """A joint at rest is held by all of it, also a light one that would be fast within a step."""
    text = model_text(kp=15.0, friction=0.1).replace('armature="0.02"', f'armature="{rotor}"')
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = windows_of(sim.arm, [record(text, 1, 21.0, breakaway=breakaway)], ["run"])
    point = nominal_point(data, nominal_controller(sim))
    known = {name: np.full(2, value) for name, value in zip(FADING, breakaway, strict=True)}
    left, without = (joint_rms(data, evaluate(data, LoopFit({**point, **more}, ((), ()))).rms) for more in (known, {}))
    assert (left < 0.0021).all()
    assert (left < 0.6 * without).all()


def test_another_gain_shows() -> None:
    data, point = _windows(model_text(kp=30.0, friction=0.2))
    found = evaluate(data, LoopFit(point, ((), ())))
    assert (joint_rms(data, found.rms) > 0.01).all()


def test_slopes_are_those_of_the_residual() -> None:
    data, point = _windows()
    one = np.ones(2)
    scales = Scales(one, one, 0.02 * one, 0.05 * one)
    fit = LoopFit(point, (("kp", "viscous"), ("kp", "viscous")))
    now, slopes = jacobian(data, fit, scales, fit.active)
    ahead = LoopFit({**point, "kp": point["kp"] * np.exp(0.03)}, fit.active)
    change = jacobian(data, ahead, scales, ((), ()))[0] - now
    for j in range(2):
        expected = 0.03 * slopes[j][0]
        assert np.linalg.norm(change[:, j] - expected) < 0.15 * np.linalg.norm(expected)


def test_a_missing_command_switches_the_servo_off() -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    recording = record(TEXT, 2, 12.0)
    recording.position_command[300:] = np.nan
    data = windows_of(sim.arm, [recording], ["run"])
    assert data.served[:200, :, 0].all()
    assert not data.served[-1, :, -1].any()


def test_damping_of_an_actuator_acts_within_its_limit() -> None:
    """A strongly damped servo at its limit still moves as MuJoCo's does: the limit clips gain and damping together."""
    text = model_text(kp=15.0, friction=0.2, damping=0.05)
    text = text.replace('kp="15.0"', 'kp="15.0" kv="2.0" forcerange="-1.0 1.0"')
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = windows_of(sim.arm, [record(text, 1, 20.0)], ["run"])
    point = nominal_point(data, nominal_controller(sim))
    rms = joint_rms(data, evaluate(data, LoopFit(point, ((), ()))).rms)
    moved = np.sqrt(np.mean((data.command - data.recorded) ** 2, axis=(0, 2)))
    assert (rms < np.maximum(0.05 * moved, 2e-3)).all()
    outside = joint_rms(data, evaluate(data, LoopFit({**point, "kv": np.zeros(2)}, ((), ()))).rms)
    assert (outside > 3.0 * rms).any()


def test_a_pid_with_slew_limit_and_delay_moves_as_mujocos_does() -> None:
    spec = mujoco.MjSpec.from_string(model_text(kp=15.0, friction=0.2))
    for servo in spec.actuators:
        servo.set_to_pid(kp=15.0, kv=0.3, slewmax=1.0, ctrlspec=POSITION_INPUT)
        servo.delay, servo.nsample = 0.04, 90
    spec.compile()
    text = spec.to_xml()
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = windows_of(sim.arm, [record(text, 1, 20.0)], ["run"])
    point = nominal_point(data, nominal_controller(sim))
    off = {"slew": np.full(2, np.inf), "delay": np.zeros(2)}
    own = joint_rms(data, evaluate(data, LoopFit(point, ((), ()))).rms)
    for name, values in off.items():
        without = joint_rms(data, evaluate(data, LoopFit({**point, name: values}, ((), ()))).rms)
        assert (without > 3.0 * own).any(), name
    assert (own < 0.004).all()


def test_back_emf_damps_only_while_the_servo_is_on() -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    recording = record(TEXT, 2, 12.0)
    on = windows_of(sim.arm, [recording], ["run"])
    recording.position_command[300:] = np.nan
    off = windows_of(sim.arm, [recording], ["run"])
    point = nominal_point(on, nominal_controller(sim))
    braked = {**point, "viscous": point["viscous"] - 0.3, "back_emf": np.full(2, 0.3)}
    same, free = (np.abs(simulate(each, batch([point])) - simulate(each, batch([braked]))).max() for each in (on, off))
    assert same < 1e-12
    assert free > 1e-3


def test_an_effect_begins_in_place_of_another_with_the_torque_closest_to_it() -> None:
    random = np.random.default_rng(4)
    first, second, third = random.normal(size=(3, 50, 2, 4))
    torque = 0.3 * first - 1.2 * second
    np.testing.assert_allclose(_like(torque, [first, second, third]), [0.3, -1.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(_like(torque, [2.0 * torque, 0.0 * torque]), [0.5, 0.0], atol=1e-6)


def test_a_spring_does_not_push_away_from_its_rest() -> None:
    """As in the fit of torques; a negative one fits the range of one recording and nothing beyond."""
    data, _ = _windows()
    ones = np.ones(data.joints)
    assert step_parameter("spring", 0.1, -50.0, Scales(ones, ones, ones, ones), 0) == 0.0
    assert step_parameter("offset", 0.1, -50.0, Scales(ones, ones, ones, ones), 0) < 0.0
