"""Source and unit of a torque channel, single rules."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, motion

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.check import check_recording
from sim_gap.checks.rigid_fit import ChannelMotion, RigidFit, fit_rigid
from sim_gap.checks.torque_source import find_gain_command, find_same, find_source, find_unsigned
from sim_gap.checks.torque_unit import find_absent, find_joint_scale, find_outgrown, find_scale
from sim_gap.model.load import load_model

RATE = 25.0


@pytest.mark.parametrize(("factor", "found"), [(1.0, 0), (0.06, 1)])
def test_a_unit_of_one_joint_is_found_although_friction_hides_its_torque(factor: float, found: int):
    """The friction of the first joint is five times the model's torque, which correlates with what it leaves by 0.6."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    torque = arm.torque(q, v, a)
    random = np.random.default_rng(1)
    noise = 1.2 * torque[:, 0].std() * np.convolve(random.normal(size=len(q)), np.ones(9) / 3.0, "same")
    torque[:, 0] += 5.0 * torque[:, 0].std() * np.tanh(v[:, 0] / 0.02) + noise
    torque[:, 0] *= factor
    read = ChannelMotion(q, v, a, torque, "tau_motor")
    assert len(find_joint_scale(arm, read, AS_IT_IS)) == found


@pytest.mark.parametrize(("others", "found"), [((1.9, 1.6), 0), ((2.6, 2.5), 1)])
def test_a_load_at_the_last_joint_is_no_unit(others: tuple[float, float], found: int):
    """A body of 1.5 kg on a link of 1.5 kg: the one strong joint reads 2.4 times the model, the others do not."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    scale, own, spread = np.array([*others, 2.43]), np.array([0.06, 0.07, 0.32]), np.array([16.0, 3.7, 2.1])
    correlation, explained = np.array([0.93, 0.98, 0.99]), np.full(3, 0.99)
    fit = RigidFit(explained, scale, correlation, own, np.zeros(3), spread)
    assert fit.strong.tolist() == [False, False, True]
    read = ChannelMotion(*np.zeros((4, 10, 3)), "tau")
    assert len(find_scale(arm, fit, read, AS_IT_IS)) == found


@pytest.mark.parametrize(("friction", "found"), [(0.0, 0), (3.0, 1)])
def test_friction_is_looked_for_in_joints_that_move(friction: float, found: int):
    """Two joints are held and tremble with a torque that another motion makes: no friction of theirs."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    tremble = np.sin(7.0 * np.arange(len(q)) / RATE)
    for still in (1, 2):
        q[:, still], v[:, still], a[:, still] = 0.3 + 1e-4 * tremble, 7e-4 * tremble, 0.0
    read = arm.torque(q, v, a) + friction * np.sign(v) * [1.0, 0.0, 0.0]
    read[:, 1:] += 0.5 * tremble[:, None]
    moved = ChannelMotion(q, v, a, read, "tau")
    findings = find_source(fit_rigid(arm, moved), SimpleNamespace(reading={"tau"}), moved, AS_IT_IS)
    assert len(findings) == found


@pytest.mark.parametrize("column", [0, 2])
def test_a_link_sensor_without_the_models_torque_is_asked_about(column: int):
    """The gear of a motor may hold the load, a sensor on the link feels it."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    read = arm.torque(q, v, a)
    small = 0.05 * np.random.default_rng(2).normal(size=len(q))
    for channel, count in (("tau", 1), ("tau_motor", 0)):
        wrong = read.copy()
        wrong[:, column] = small
        moved = ChannelMotion(q, v, a, wrong, channel)
        found = find_absent(arm, fit_rigid(arm, moved), moved, AS_IT_IS)
        assert len(found) == count
        assert all(each.joint == arm.names[column] and not each.corrected for each in found)
    sound = ChannelMotion(q, v, a, read + small[:, None], "tau")
    assert not find_absent(arm, fit_rigid(arm, sound), sound, AS_IT_IS)


@pytest.mark.parametrize(
    ("unsigned", "noise", "count"), [(True, 0.7, 1), (True, 0.0, 1), (False, 0.7, 0), (False, 0.0, 0)]
)
def test_an_unsigned_reading_is_found_beside_noise_and_one_with_an_offset_is_not(unsigned, noise, count):
    """Noise of 0.7 of the torque: the amounts hardly go together (correlation 0.5), the signed torques do."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    read = arm.torque(q, v, a)
    joint = int(np.argmin(np.abs(read.mean(0) / read.std(0))))
    own = read[:, joint] + noise * read[:, joint].std() * np.random.default_rng(4).normal(size=len(q))
    read[:, joint] = np.abs(own) + 1e-3 if unsigned else own - own.min() + 0.1
    found = find_unsigned(arm, ChannelMotion(q, v, a, read, "tau"), AS_IT_IS)
    assert [each.joint for each in found] == [arm.names[joint]] * count


@pytest.mark.parametrize(("raised_by", "count"), [(0.0, 1), (0.3, 0)])
def test_an_unsigned_reading_that_does_not_follow_the_model_turns_round_at_zero(raised_by: float, count: int):
    """The last joint's velocity, rectified, is half explained as friction, and has nothing of the model's torque."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    read = arm.torque(q, v, a)
    own = 0.3 * np.abs(v[:, 2]) + 0.7 * v[:, 2].clip(0.0)
    read[:, 2] = own + raised_by * own.std()
    found = find_unsigned(arm, ChannelMotion(q, v, a, read, "tau"), AS_IT_IS)
    assert [each.joint for each in found] == [arm.names[2]] * count


@pytest.mark.parametrize(("friction", "count"), [(1.0, 0), (8.0, 0), (300.0, 1)])
def test_a_joint_of_friction_alone_that_reads_more_than_those_before_it_is_asked_about(friction: float, count: int):
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    read = arm.torque(q, v, a) + friction * np.sign(v) * [0.0, 0.0, 1.0]
    found = find_outgrown(arm, arm, ChannelMotion(q, v, a, read, "tau_motor"), AS_IT_IS)
    assert [each.joint for each in found] == ["joint_3"] * count
    stated = parse_corrections(units=["tau_motor_3=N·m"])
    assert not find_outgrown(arm, arm, ChannelMotion(q, v, a, read, "tau_motor"), stated)


def of_motors(kp: float) -> Recording:
    """As drives without torque sensors are recorded; with gains the command is their law at the row's readings."""
    t, q, v, _ = motion(3, 30.0, 100.0, seed=4)
    random = np.random.default_rng(5)
    target = np.roll(q, -3, axis=0) + 2e-4 * random.standard_normal(q.shape)
    torque = np.sin(q) + 0.1 * np.sign(v)
    command = torque + kp * (target - q) + 1e-3 * random.standard_normal(q.shape)
    return Recording(
        t, q, torque=torque, velocity=v, motor_torque=torque.copy(), torque_command=command, position_command=target
    )


def test_one_reading_in_both_torque_channels_is_the_motors():
    recording = of_motors(0.0)
    (finding,) = find_same(recording, AS_IT_IS)
    assert finding.corrected
    assert finding.option == "--effort-is motor"
    corrected = parse_corrections(effort="motor").apply(recording, "run.csv")
    assert corrected.torque is None
    np.testing.assert_array_equal(corrected.motor_torque, recording.motor_torque)
    assert not find_same(replace(recording, torque=recording.torque + 1e-6), AS_IT_IS)
    assert not find_same(recording, parse_corrections(effort="link"))


def test_a_command_that_is_the_law_of_gains_at_the_rows_readings_is_found():
    (finding,) = find_gain_command(of_motors(60.0), AS_IT_IS)
    assert (finding.channel, finding.corrected) == ("tau_cmd", True)
    assert not find_gain_command(of_motors(0.0), AS_IT_IS)
    assert not find_gain_command(of_motors(60.0), parse_corrections(clock=["tau_cmd=0"]))


def test_a_recording_without_torque_sensors_is_diagnosed_from_motor_torque_alone():
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    recording = of_motors(60.0)
    torque = arm.torque(recording.position, recording.velocity, np.gradient(recording.velocity, 0.01, axis=0))
    recording = replace(recording, torque=torque, motor_torque=torque.copy())
    checked, findings = check_recording(arm, recording, "run.csv", AS_IT_IS)
    assert [each.finding for each in findings] == ["effort_source", "clock"]
    assert checked.torque is None
    assert checked.torque_command is None


@pytest.mark.parametrize(("factor", "found"), [(1.0, 0), (0.08, 1)])
def test_a_wrist_on_which_something_pulls_tells_no_unit(factor: float, found: int):
    """The model has next to no torque there; all joints in another unit do tell."""
    nominal = mujoco.MjModel.from_xml_string(THREE)
    nominal.body_mass[-1], nominal.body_inertia[-1] = 1e-3, 1e-6
    arm = load_model(nominal).arm
    _, q, v, a = motion(3, 60.0, RATE, seed=3)
    read = factor * arm.torque(q, v, a)
    if found == 0:
        read[:, 2] *= 80.0
        read[:, :2] += np.random.default_rng(1).normal(0.0, 3.0 * read[:, :2].std(), (len(q), 2))
    moved = ChannelMotion(q, v, a, read, "tau_motor")
    assert len(find_scale(arm, fit_rigid(arm, moved), moved, AS_IT_IS)) == found
