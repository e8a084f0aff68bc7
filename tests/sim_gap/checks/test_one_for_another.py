"""One fault is not told as another one that changes a recording of a real arm alike."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from doubts import doubt

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.checks.check import check_recording
from sim_gap.model.load import load_model

FILES = {
    "ur10e": ("ur10e", "train_a.csv.gz"),
    "panda": ("panda", "recording.csv.gz"),
    "lwr4": ("lwr4", "train.csv.gz"),
    "pendulum": ("double_pendulum", "designc_a.csv.gz", "sim_design_c.xml"),
}


@pytest.fixture(scope="module")
def arms(realdata: Path):
    """Nominal arm and recording of real arms, by the folder of their recordings."""

    @cache  # those that a run asks for, once
    def loaded(folder: str, file: str, sim: str = "sim.xml"):
        recording = load_recording(realdata / folder / file)
        return load_model(realdata / folder / sim, (), recording.n).arm, recording

    class Arms:
        def __getitem__(self, name: str):
            return loaded(*FILES[name])

    return Arms()


def moved(recording: Recording, joint: int, angle: float) -> Recording:
    position = recording.position.copy()
    position[:, joint] += angle
    return replace(recording, position=position)


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("folder", "joint", "angle"),
    [("ur10e", 1, -0.2), ("ur10e", 2, 0.28), ("panda", 1, 0.2), ("lwr4", 1, 0.2), ("lwr4", 3, -0.2)],
)
def test_a_zero_is_no_order_no_delay_and_no_tilt(arms, folder, joint, angle):
    """LWR4's joints 2 and 5 move alike: exchanged, they fit nearly as well as with the zero put right."""
    arm, recording = arms[folder]
    assert check_recording(arm, moved(recording, joint, angle), "r", AS_IT_IS)[1] == []


@pytest.mark.long
def test_velocities_of_other_joints_are_no_other_order_of_the_positions(arms):
    arm, recording = arms["panda"]
    checked, found = check_recording(arm, replace(recording, velocity=recording.velocity[:, ::-1]), "r", AS_IT_IS)
    assert [(each.finding, each.channel) for each in found] == [("order", "dq")]
    np.testing.assert_array_equal(checked.position, recording.position)


@pytest.mark.long
@pytest.mark.parametrize(("folder", "by_s"), [("panda", -1.2), ("lwr4", 0.6), ("lwr4", -0.9)])
def test_a_delay_is_no_unsigned_joint_and_no_order_that_changes(arms, folder, by_s):
    arm, recording = arms[folder]
    t = recording.t
    late = replace(recording, torque=np.column_stack([np.interp(t - by_s, t, x) for x in recording.torque.T]))
    (finding,) = check_recording(arm, late, "r", AS_IT_IS)[1]
    assert finding.finding == "clock"
    assert float(finding.option.partition("=")[2]) == pytest.approx(-by_s, abs=0.08)


@pytest.mark.long
@pytest.mark.parametrize("joint", [4, 6])
def test_one_joint_in_another_unit_makes_no_motors_of_link_sensors(arms, joint):
    arm, recording = arms["panda"]
    torque = recording.torque.copy()
    torque[:, joint] *= 30.0  # as much as ten may be the friction of a bearing
    column = f"tau_{joint + 1}"
    doubt(
        check_recording(arm, replace(recording, torque=torque), "r", AS_IT_IS),
        f"amperes, or in another unit.*--units {column}=A:K",
    )
    stated = parse_corrections(units=[f"{column}=N·m"])
    assert check_recording(arm, replace(recording, torque=torque), "r", stated)[1] == []


def test_a_motion_that_repeats_tells_no_delay_of_a_motors_effort(arms):
    arm, recording = arms["pendulum"]
    effort = replace(recording, torque=recording.motor_torque, motor_torque=None)
    assert not any(each.finding == "clock" for each in check_recording(arm, effort, "r", AS_IT_IS)[1])
