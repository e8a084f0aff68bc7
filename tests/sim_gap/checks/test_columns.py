"""Wrong columns of one torque channel: certain where a sound arm cannot have made it, else nothing is said."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, motion

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from sim_gap.checks.columns import find_wrong_columns
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.hypotheses import Hypothesis, hypotheses
from sim_gap.checks.sound_arm import LEAST_RESIDUAL, ChannelMotion, likelihood, measurements
from sim_gap.model.load import load_model

ARM = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
RATE, SECONDS = 50.0, 60.0
MOTION = motion(3, SECONDS, RATE, seed=3)


def channel(reading: np.ndarray, source: str = "tau_motor", moved=MOTION) -> ChannelMotion:
    t, q, v, a = moved
    size, idle, duration = reading.std(0), np.ones(3, bool), float(t[-1] - t[0])
    count, least = measurements(q, v, size, duration), LEAST_RESIDUAL * size
    return ChannelMotion(q, v, a, reading, source, duration, size, count, least, idle, source != "tau")


def found(read: ChannelMotion, stated=AS_IT_IS) -> RecordingFinding | None:
    return find_wrong_columns(ARM, read, stated, ())


def sound(friction: float = 0.0, seed: int = 1) -> np.ndarray:
    """Torques of the nominal arm, friction as a share of each, and a little noise."""
    _, q, v, a = MOTION
    torque = ARM.torque(q, v, a)
    torque += friction * torque.std(0) * np.tanh(v / 0.02)
    return torque + 0.03 * torque.std(0) * np.random.default_rng(seed).normal(size=q.shape)


def shifted(reading: np.ndarray, by_s: float | np.ndarray) -> np.ndarray:
    """Readings that come so much later, of all joints or of each [s]."""
    t = MOTION[0]
    return np.stack([np.interp(t - by, t, x) for by, x in zip(by_s * np.ones(3), reading.T, strict=True)], axis=1)


def test_a_sound_channel_is_explained_to_the_floor_of_what_models_leave():
    read = channel(sound(friction=0.3))
    assert found(read) is None
    share = np.exp(likelihood(ARM, read).costs.sum(1) / read.count)
    np.testing.assert_array_less(share, 1.3 * LEAST_RESIDUAL)


@pytest.mark.parametrize("late", [0.4, -0.3, 1.1])
def test_a_channel_with_another_clock_is_moved(late: float):
    finding = found(channel(shifted(sound(), late), "tau"))
    assert finding is not None
    assert finding.corrected
    assert float(finding.option.removeprefix("--clock tau=")) == pytest.approx(-late, abs=0.02)
    assert found(channel(shifted(sound(), late), "tau"), parse_corrections(clock=["tau=0"])) != finding


@pytest.mark.parametrize("late", [0.02, -0.02])
def test_a_drive_may_follow_by_some_hundredths_of_a_second(late: float):
    assert found(channel(shifted(sound(0.3), late))) is None


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_what_one_joint_shows_is_no_clock_of_the_channel(joint: int):
    finding = found(channel(shifted(sound(0.3), 0.3 * (np.arange(3) == joint))))
    assert finding is None or finding.finding != "clock"


def test_a_motion_that_repeats_tells_a_delay_but_for_whole_periods():
    t = np.arange(0.0, 24.0, 1.0 / RATE)
    period, phase = 1.0, np.array([0.3, 1.5, 2.9])
    w = 2.0 * np.pi / period
    q = 0.5 * np.sin(w * t[:, None] + phase)
    v, a = 0.5 * w * np.cos(w * t[:, None] + phase), -w * w * q
    reading = np.roll(ARM.torque(q, v, a), round(0.4 * RATE), axis=0)
    finding = found(channel(reading, "tau", (t, q, v, a)))
    assert finding is None or -float(finding.option.removeprefix("--clock tau=")) % period == pytest.approx(0.4)


@pytest.mark.sample(2)
@pytest.mark.parametrize("factor", [0.01, 0.05, 20.0, 1000.0])
def test_another_unit_of_all_joints_is_asked_about(factor: float):
    finding = found(channel(factor * sound(0.3)))
    assert finding is not None
    assert not finding.corrected
    assert (finding.finding, finding.joint) == ("scale", "all")
    settled = found(channel(factor * sound(0.3)), parse_corrections(units=["tau_motor=N·m"]))
    assert settled is None or settled.finding != "scale"


@pytest.mark.parametrize("gains", [(0.75, 1.3, 0.8), (1.3, 1.4, 1.25), (0.8, 0.75, 0.7)])
def test_torque_constants_that_are_off_by_a_third_are_no_unit(gains: tuple[float, ...]):
    assert found(channel(sound(0.3) * np.array(gains))) is None


@pytest.mark.parametrize(("friction", "asked"), [(1.0, False), (8.0, False), (3000.0, True)])
def test_friction_beyond_what_the_whole_arm_weighs_is_in_another_unit(friction: float, asked: bool):
    read = sound() + friction * np.tanh(MOTION[2] / 0.02) * [0.0, 0.0, 1.0]
    finding = found(channel(read))
    assert (finding is not None and (finding.finding, finding.joint) == ("scale", "joint_3")) == asked
    assert asked or finding is None


@pytest.mark.parametrize(("unsigned", "noise"), [(True, 0.3), (True, 0.0), (False, 0.7), (False, 0.0)])
def test_an_unsigned_reading_is_told_from_one_with_an_offset(unsigned: bool, noise: float):
    read = sound()
    joint = int(np.argmin(np.abs(read.mean(0) / read.std(0))))
    own = read[:, joint] + noise * read[:, joint].std() * np.random.default_rng(4).normal(size=len(read))
    read[:, joint] = np.abs(own) + 1e-3 if unsigned else own - own.min() + 0.1
    finding = found(channel(read, "tau"))
    assert (finding is not None and (finding.finding, finding.joint) == ("unsigned", ARM.names[joint])) == unsigned
    assert unsigned or finding is None


def test_friction_of_all_joints_is_a_motors_and_of_one_is_not():
    finding = found(channel(sound(0.4), "tau"))
    assert finding is not None
    assert finding.option == "--effort-is motor"
    rough = sound() + 3.0 * np.tanh(MOTION[2] / 0.02) * [0.0, 1.0, 0.0]
    assert found(channel(rough, "tau")) is None


@pytest.mark.parametrize(("friction", "certain"), [(0.3, True), (0.8, False)])
def test_gravity_that_was_subtracted_is_added_and_asked_about_where_friction_hides_it(friction: float, certain: bool):
    still = np.zeros_like(MOTION[1])
    weightless = sound(friction) - ARM.torque(MOTION[1], still, still)
    finding = found(channel(weightless))
    assert finding is not None
    assert finding.option == "--effort-is without-gravity"
    assert finding.corrected == certain
    assert finding.evidence.startswith("perhaps") != certain
    assert found(channel(sound(friction))) is None


@pytest.mark.parametrize("idle", [0, 2])
def test_a_motor_that_is_idle_while_its_joint_is_dragged_along_is_no_fault(idle: int):
    read = sound(0.3)
    read[:, idle] = 0.02 * read[:, idle].std() * np.random.default_rng(2).normal(size=len(read))
    assert found(channel(read)) is None


def test_joints_that_rest_are_not_judged():
    t, q, v, a = (x.copy() for x in MOTION)
    for still in (1, 2):
        q[:, still], v[:, still], a[:, still] = 0.3, 0.0, 0.0
    read = ARM.torque(q, v, a) + 0.3 * np.tanh(v / 0.02)
    read[:, 1:] *= -30.0
    assert found(channel(read, moved=(t, q, v, a))) is None


def test_hypotheses_change_what_they_say():
    read = channel(sound())

    def of(option: str) -> Hypothesis:
        return next(each for each in hypotheses(ARM, read, AS_IT_IS, ()) if each.option == option)

    degrees = replace(read, q=np.degrees(read.q), v=np.degrees(read.v), a=np.degrees(read.a))
    (unit,) = [each for each in hypotheses(ARM, degrees, AS_IT_IS, ()) if each.option == "--units q=deg"]
    np.testing.assert_allclose(unit.change(degrees).q, read.q)
    np.testing.assert_allclose(of("--sign q_2=-1").change(read).v[:, 1], -read.v[:, 1])
    exchanged = of("--map tau_motor_1=tau_motor_3,tau_motor_3=tau_motor_1").change(read)
    np.testing.assert_allclose(exchanged.reading, read.reading[:, [2, 1, 0]])
    np.testing.assert_allclose(exchanged.size, read.size[[2, 1, 0]])
    settled = parse_corrections(sign=["q_2=1"], zero=["q_2=0"])
    assert not any(each.option.startswith(("--sign q_2", "--zero q_2")) for each in hypotheses(ARM, read, settled, ()))
