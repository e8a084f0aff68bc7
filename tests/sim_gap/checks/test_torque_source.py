"""Torque channels that repeat another one, or that are the law of a drive's gains."""

from dataclasses import replace

import mujoco
import numpy as np
from wrong_arms import THREE, motion

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.check import check_recording, find_gain_command, find_same
from sim_gap.model.load import load_model

RATE = 25.0


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
    corrected = parse_corrections(effort_is="motor").apply(recording, "run.csv")
    assert corrected.torque is None
    np.testing.assert_array_equal(corrected.motor_torque, recording.motor_torque)
    assert not find_same(replace(recording, torque=recording.torque + 1e-6), AS_IT_IS)
    assert not find_same(recording, parse_corrections(effort_is="link"))


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
