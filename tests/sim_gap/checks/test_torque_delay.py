"""A torque channel's clock against the positions': found if it is one delay, not if several would do."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from wrong_arms import THREE, motion

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from sim_gap.checks.rigid_fit import ChannelMotion
from sim_gap.checks.torque_delay import find_delay, find_short_delay
from sim_gap.model.load import load_model

RATE, LATE = 25.0, 0.4
PERIOD = 1.0


def late(t: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray):
    """Arm and motion, its torque read `LATE` seconds late."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    torque = arm.torque(q, v, a)
    shifted = np.stack([np.interp(t - LATE, t, column) for column in torque.T], axis=1)
    random = np.random.default_rng(1)
    return arm, ChannelMotion(q, v, a, shifted + 0.01 * random.normal(size=q.shape), "tau")


def test_a_late_channel_is_found():
    arm, read = late(*motion(3, 60.0, RATE, seed=3))
    (finding,), _ = find_delay(arm, read, RATE, AS_IT_IS)
    assert float(finding.option.split("=")[1]) == pytest.approx(-LATE, abs=0.02)


@pytest.mark.parametrize(("late_s", "found"), [(0.025, 0), (0.06, 1), (-0.04, 1)])
def test_a_motor_may_follow_late_by_some_hundredths_of_a_second_and_never_early(late_s: float, found: int):
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    t, q, v, a = motion(3, 60.0, 50.0, seed=3)
    t, v, a = 0.5 * t, 2.0 * v, 4.0 * a
    torque = np.stack([np.interp(t - late_s, t, column) for column in arm.torque(q, v, a).T], axis=1)
    assert len(find_delay(arm, ChannelMotion(q, v, a, torque, "tau_motor"), 100.0, AS_IT_IS)[0]) == found


def test_a_motion_that_repeats_does_not_tell_by_how_many_periods():
    t = np.arange(0.0, 12.0, 1.0 / RATE)
    w, phase = 2.0 * np.pi / PERIOD, np.array([0.3, 1.5, 2.9])
    q = 0.5 * np.sin(w * t[:, None] + phase)
    v, a = 0.5 * w * np.cos(w * t[:, None] + phase), -w * w * q
    findings, _ = find_delay(*late(t, q, v, a), RATE, AS_IT_IS)
    assert not findings


def read_late(by_s: tuple[float, float, float], channel: str = "tau_motor") -> ChannelMotion:
    """Motion of three joints with friction, of which each motor's torque is read late by its own time."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    t, q, v, a = motion(3, 60.0, 50.0, seed=3)
    t, v, a = 0.5 * t, 2.0 * v, 4.0 * a
    torque = arm.torque(q, v, a)
    torque += 0.3 * torque.std(axis=0) * np.tanh(v / 0.02)
    late = np.stack([np.interp(t - by, t, x) for by, x in zip(by_s, torque.T, strict=True)], axis=1)
    noise = 0.05 * torque.std(axis=0) * np.random.default_rng(4).normal(size=q.shape)
    return ChannelMotion(q, v, a, late + noise, channel)


@pytest.mark.parametrize("by_s", [-0.02, 0.02])
def test_a_short_delay_of_all_motors_is_that_of_their_clock(by_s: float):
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    read = read_late((by_s, by_s, by_s))
    (finding,) = find_short_delay(arm, read, 100.0, AS_IT_IS)
    assert float(finding.option.split("=")[1]) == pytest.approx(-by_s, abs=0.006)
    assert finding.corrected
    stated = parse_corrections(clock=["tau_motor=0"])
    assert not find_short_delay(arm, read, 100.0, stated)


@pytest.mark.parametrize("by_s", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.02, -0.02, 0.02)])
def test_a_delay_of_one_drive_is_its_own(by_s: tuple[float, float, float]):
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    assert not find_short_delay(arm, read_late(by_s), 100.0, AS_IT_IS)


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_what_one_joint_shows_early_is_no_clock_of_the_link_sensors(joint: int):
    """Play between encoder and link does so, of the torque of a joint nearer to the base."""
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    read = read_late(tuple(-0.04 * (j == joint) for j in range(3)), "tau")
    hardly_tell = 0.6 * read.reading.std(axis=0) * (np.arange(3) != joint)
    noise = hardly_tell * np.random.default_rng(5).normal(size=read.q.shape)
    assert not find_short_delay(arm, replace(read, reading=read.reading + noise), 100.0, AS_IT_IS)


@pytest.mark.parametrize(("by_s", "found"), [(0.03, 0), (-0.03, 1)])
def test_a_link_sensor_may_be_late_and_never_early(by_s: float, found: int):
    arm = load_model(mujoco.MjModel.from_xml_string(THREE)).arm
    assert len(find_short_delay(arm, read_late((by_s, by_s, by_s), "tau"), 100.0, AS_IT_IS)) == found


def test_few_rows_show_no_short_delay():
    arm, read = load_model(mujoco.MjModel.from_xml_string(THREE)).arm, read_late((0.02, 0.02, 0.02))
    few = ChannelMotion(read.q[:30], read.v[:30], read.a[:30], read.reading[:30], "tau_motor")
    assert not find_short_delay(arm, few, 100.0, AS_IT_IS)
