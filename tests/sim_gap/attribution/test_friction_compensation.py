"""Friction compensation is told from the recordings alone: held by the command, or missing in the torque channel."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.friction_compensation import held_in_commands

DRY = np.array([2.0, 1.5, 0.8])


def arm(seed: int) -> Recording:
    """A recording of a command alone, with friction, and a velocity with noise."""
    made = record(model(), Wrong(coulomb=DRY), seed=seed, seconds=30)
    noise = 0.005 * np.random.default_rng(seed).normal(size=made.position.shape)
    return replace(made, torque=None, motor_torque=None, torque_command=made.motor_torque, velocity=speed(made) + noise)


def speed(made: Recording) -> np.ndarray:
    return np.asarray(np.gradient(made.position, made.t, axis=0))


def compensation(velocity: np.ndarray) -> np.ndarray:
    return np.asarray(DRY * 2.0 / np.pi * np.arctan(velocity / 0.02) + 0.3 * velocity)


def test_a_command_that_holds_it():
    """What is measured drives the law, a sample late; the plan's own friction, which steps at reversals, is none."""
    made, quiet = arm(1), record(model(), Wrong(), seed=1, seconds=30, noise=1e-3).motor_torque
    late = np.vstack([made.velocity[:1], made.velocity[:-1]])
    holds = replace(made, torque_command=quiet + compensation(late))
    for channel in (holds.torque_command, holds.velocity):
        channel[500:520] = np.nan
    found = held_in_commands([made, holds], ["off", "on"])
    assert [(each.recording, each.joint) for each in found] == [("on", name) for name in made.names]
    assert [each.torque for each in found] == pytest.approx(DRY, rel=0.2)


def test_a_damping_controller_is_none():
    made = arm(2)
    damped = replace(made, torque_command=made.torque_command - 4.0 * (made.velocity - speed(made)))
    assert not held_in_commands([damped], ["damped"])


def test_a_channel_that_lacks_it():
    """One of three recordings shows no friction of joints 1 and 2: named, and no other joint or recording."""
    made = [arm(3 + k) for k in range(3)]
    true = speed(made[1])
    friction = DRY * np.sign(true) * [1.0, 1.0, 0.0]
    made[1] = replace(made[1], torque_command=made[1].torque_command - friction)
    answer = diagnose(model(), made[:2], made[2:], labels=["a", "on", "b"])
    found = [(each.recording, each.joint, each.held) for each in answer.friction_compensation]
    assert found == [("on", "joint_1", False), ("on", "joint_2", False)]
    assert sum("compensates friction with a torque that tau_cmd does not contain" in note for note in answer.notes) == 2
    assert [each["recording"] for each in answer.to_json()["friction_compensation"]] == ["on", "on"]


@pytest.mark.long
def test_a_joint_that_goes_one_way_tells_nothing_of_it(realdata):
    """Its friction and any other constant are one: joint 6 was said to have -9.6 N·m of friction."""
    folder = realdata / "kinova_gen3"
    names = ["opti_traj_testing1", *(f"joint_{j}_trapez" for j in range(1, 8)), "RecordTrajectory_quadratic"]
    made = [load_recording(folder / f"{name}.csv.gz") for name in names]
    assert not diagnose(folder / "sim.urdf", made[:-1], made[-1:], labels=names).friction_compensation


@pytest.mark.long
def test_which_runs_of_the_double_pendulum_had_it(realdata):
    """On in on_c alone; on_c_feedforward is the same run without the compensating part of its command."""
    folder = realdata / "double_pendulum"
    runs = ("off_b", "off_c", "on_c", "on_c_feedforward")
    made = [load_recording(folder / f"{run}.csv.gz") for run in runs]
    answer = diagnose(folder / "sim.xml", made[:2], made[2:], labels=runs)
    found = {(each.recording, each.joint, each.held) for each in answer.friction_compensation}
    assert found == {(run, f"joint_{j}", run == "on_c") for run in runs[2:] for j in (1, 2)}


def test_a_trace_of_a_dry_law_in_a_clean_command_is_none():
    made = arm(2)
    clean = record(model(), Wrong(), seed=2, seconds=30, noise=0.0).motor_torque
    assert not held_in_commands([replace(made, torque_command=clean + 2.5e-3 * compensation(made.velocity))], ["trace"])
