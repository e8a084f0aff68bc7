"""Kinds of recordings that others make: gravity taken off, one joint moving, one way only, a pendulum that swings."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from wrong_arms import Wrong, model, motion, record, record_along

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.api import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.checks.check import check_recording, check_recordings
from sim_gap.model.load import load_model

N = model().nv


def values(answer: Diagnosis, effect: str, name: str) -> np.ndarray:
    """Fitted values of one parameter by joint; NaN where a joint has none."""
    found = {
        joint: each[name].value for c in answer.causes if c.effect == effect for joint, each in c.parameters.items()
    }
    return np.array([found.get(joint, 0.0) for joint in answer.names])


def smooth_step(t: np.ndarray, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, ...]:
    """Every joint once from start to goal, without a jerk (K, n)."""
    span = t[-1]
    s = (t / span)[:, None]
    way = goal - start
    q = start + way * s**3 * (10 - 15 * s + 6 * s**2)
    v = way * 30 * s**2 * (1 - s) ** 2 / span
    a = way * 60 * s * (1 - s) * (1 - 2 * s) / span**2
    return t, q, v, a


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_efforts_without_gravity_are_known_as_such(seed: int) -> None:
    """As drivers publish them that subtract their own model of gravity: nothing is left at rest."""
    random = np.random.default_rng(seed)
    coulomb, viscous = random.uniform(0.3, 2.0, N), random.uniform(0.2, 1.5, N)
    arm = load_model(model()).arm
    whole, parts = [], []
    for number in range(2):
        made = record(
            model(), Wrong(coulomb=coulomb, viscous=viscous), seed=10 * seed + number, seconds=30.0, rate=100.0
        )
        still = np.zeros_like(made.position)
        whole.append(replace(made, torque=None))
        gravity = arm.torque(made.position, still, still)
        parts.append(replace(made, torque=None, motor_torque=made.motor_torque - gravity))
    corrected, (finding,) = check_recordings(arm, parts, ["a", "b"], AS_IT_IS)
    assert finding.corrected
    assert finding.option == "--effort-is without-gravity"
    for own, right in zip(corrected, whole, strict=True):
        np.testing.assert_allclose(own.motor_torque, right.motor_torque, atol=1e-9)
    answer = diagnose(model(), parts[:1], parts[1:])
    assert values(answer, "friction.coulomb", "torque") == pytest.approx(coulomb, rel=0.1, abs=0.05)
    assert values(answer, "friction.viscous", "damping") == pytest.approx(viscous, rel=0.15, abs=0.35)
    stated = parse_corrections(effort_is="motor,without-gravity")
    again, found = check_recording(arm, parts[0], "r", stated)
    assert found == []
    np.testing.assert_allclose(again.motor_torque, whole[0].motor_torque, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_went_one_way_rubs(seed: int) -> None:
    """Its torque may as well have an offset, in what is fitted; every gear rubs, and the way back shows which it is."""
    random = np.random.default_rng([seed, 5])
    coulomb, viscous = random.uniform(1.0, 4.0, N), random.uniform(0.2, 1.5, N)
    start, goal = -random.uniform(0.6, 1.2, N), random.uniform(0.6, 1.2, N)
    t = np.arange(0.0, 6.0, 0.004)
    wrong = Wrong(coulomb=coulomb, viscous=viscous)
    there = record_along(smooth_step(t, start, goal), model(), wrong, seed, channels=("tau_motor",))
    back = record_along(smooth_step(t, goal, start + 0.2), model(), wrong, seed + 1, channels=("tau_motor",))
    answer = diagnose(model(), [there], [back])
    assert values(answer, "friction.coulomb", "torque") == pytest.approx(coulomb, rel=0.25)
    assert not any(cause.effect == "torque.offset" for cause in answer.causes)
    assert (answer.heldout_after < 0.3 * answer.heldout_before).all()


@pytest.mark.parametrize("friction", [0.5, 2.0, 6.0])
def test_a_wrist_that_moves_alone_is_in_no_other_unit(friction: float) -> None:
    """What the joints nearer the base read at rest says nothing of it."""
    t, q, v, a = motion(N, 20.0, 100.0, 3)
    for each in (q, v, a):
        each[:, :-1] = 0.0
    wrong = Wrong(coulomb=np.array([0.0] * (N - 1) + [friction]), viscous=0.1)
    alone = record_along((t, q, v, a), model(), wrong, channels=("tau_motor",))
    _, found = check_recording(load_model(model()).arm, alone, "r", AS_IT_IS)
    assert found == []


PENDULUM = """<mujoco><option timestep="0.0005" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="hinge" axis="0 1 0" {friction}/><inertial pos="0 0 -{length}" mass="{mass}" diaginertia="1e-3 1e-3 1e-3"/>
</body></worldbody></mujoco>"""


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(3))
def test_a_pendulum_that_swings_free_shows_its_friction(seed: int) -> None:
    """The drive is off and reads nothing: all that brakes the arm is friction, and no gear that its load locks."""
    random = np.random.default_rng([seed, 6])
    mass, length = random.uniform(0.3, 3.0), random.uniform(0.1, 0.4)
    coulomb, viscous = random.uniform(0.02, 0.06, 2) * mass * 9.81 * length
    nominal = PENDULUM.format(friction="", mass=mass, length=length)
    loss = f'frictionloss="{coulomb}" damping="{viscous}" solreffriction="0.002 1" solimpfriction="0.999 0.9999 0.001"'
    real = mujoco.MjModel.from_xml_string(PENDULUM.format(friction=loss, mass=mass, length=length))
    swings = [swing(real, start, random, 0.002 * mass * 9.81 * length) for start in (1.9, -2.4)]
    answer = diagnose(model(nominal), swings[:1], swings[1:])
    assert values(answer, "friction.coulomb", "torque") == pytest.approx([coulomb], rel=0.15)
    assert not any(cause.effect == "friction.load" for cause in answer.causes)
    assert (answer.heldout_after < 0.1 * answer.heldout_before).all()


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(2))
def test_one_swing_that_ends_at_rest_is_judged_where_it_moves(seed: int) -> None:
    random = np.random.default_rng([seed, 8])
    mass, length = random.uniform(0.5, 3.0), random.uniform(0.1, 0.3)
    coulomb, viscous = random.uniform(0.04, 0.06) * mass * 9.81 * length, random.uniform(0.005, 0.01) * mass
    loss = f'frictionloss="{coulomb}" damping="{viscous}" solreffriction="0.002 1" solimpfriction="0.999 0.9999 0.001"'
    real = mujoco.MjModel.from_xml_string(PENDULUM.format(friction=loss, mass=mass, length=length))
    nominal = PENDULUM.format(friction="", mass=mass, length=length)
    answer = diagnose(model(nominal), [swing(real, 1.9, random, 0.002 * mass * 9.81 * length)])
    assert answer.verdict in ("explained", "ambiguous")  # two seconds of it may not tell the kinds of friction apart
    assert values(answer, "friction.coulomb", "torque") == pytest.approx([coulomb], rel=0.15)


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(2))
def test_friction_behind_the_sensor_is_told_from_that_before_it(seed: int) -> None:
    """Bearings and seals rub on the link side of the sensor: both channels hold that, the motor's the gear's, too."""
    random = np.random.default_rng([seed, 9])
    gear, bearing = random.uniform(1.0, 3.0, N), random.uniform(0.3, 0.8, N)
    recordings = []
    for number in range(2):
        t, q, v, a = motion(N, 30.0, 100.0, 10 * seed + number)
        made = record_along((t, q, v, a), model(), Wrong(coulomb=gear, viscous=0.5), number)
        rubs = bearing * np.tanh(v / 0.01) + 0.2 * v
        recordings.append(replace(made, torque=made.torque + rubs, motor_torque=made.motor_torque + rubs))
    answer = diagnose(model(), recordings[:1], recordings[1:])
    assert answer.verdict == "explained"
    assert values(answer, "friction.coulomb", "torque") == pytest.approx(gear, rel=0.1)
    assert values(answer, "friction.bearing", "torque") == pytest.approx(bearing, rel=0.15)
    assert values(answer, "friction.bearing", "damping") == pytest.approx(np.full(N, 0.2), abs=0.1)


@pytest.mark.long
def test_recordings_of_some_seconds_are_diagnosed_together() -> None:
    wrong = Wrong(coulomb=0.8, viscous=0.4)
    parts = [record(model(), wrong, seed=k, seconds=2.5, rate=100.0, channels=("tau_motor",)) for k in range(5)]
    answer = diagnose(model(), parts[:4], parts[4:])
    assert values(answer, "friction.coulomb", "torque") == pytest.approx(np.full(N, 0.8), rel=0.25)


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(6))
def test_no_column_of_a_short_piece_of_a_sound_arm_is_corrected(seed: int) -> None:
    """Three seconds of two joints in motion, with friction and a payload, may look like a turned zero."""
    random = np.random.default_rng([seed, 10])
    t, q, v, a = motion(N, 3.3, 100.0, seed)
    still = random.permutation(N)[: N - 2]
    for each in (v, a):
        each[:, still] = 0.0
    q[:, still] = q[0, still]
    wrong = Wrong(coulomb=random.uniform(0.0, 2.0), viscous=random.uniform(0.0, 1.0), payload=random.uniform(0.0, 0.5))
    piece = record_along((t, q, v, a), model(), wrong, seed, channels=("tau_motor",))
    assert not [each for each in check_recording(load_model(model()).arm, piece, "r", AS_IT_IS)[1] if each.corrected]


def swing(real: mujoco.MjModel, start: float, random: np.random.Generator, noise: float) -> Recording:
    data = mujoco.MjData(real)
    data.qpos[0] = start
    positions = []
    for _ in range(2000):
        positions.append(data.qpos[0] + 2e-4 * random.normal())
        mujoco.mj_step(real, data, nstep=8)
    torque = noise * random.normal(size=(2000, 1))
    return Recording(t=0.004 * np.arange(2000), position=np.array(positions)[:, None], motor_torque=torque)


@pytest.mark.long
def test_a_doubtful_unit_leaves_the_answer_open() -> None:
    wrong = Wrong(coulomb=0.5, viscous=0.3)
    made = [record(model(), wrong, seed=k, seconds=20.0, channels=("tau_motor",)) for k in range(2)]
    amperes = [replace(each, motor_torque=each.motor_torque / 12.0) for each in made]
    answer = diagnose(model(), amperes[:1], amperes[1:])
    assert answer.verdict in ("ambiguous", "unexplained")
    (finding,) = answer.checks
    assert not finding.corrected
    assert "--units tau_motor=A:K" in finding.option
    assert diagnose(model(), made[:1], made[1:]).verdict == "explained"
