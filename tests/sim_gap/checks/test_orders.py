"""Columns of a real arm's recording in any order: put right where one order alone explains them, else asked about."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlink.recording.corrections import AS_IT_IS
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.checks.check import check_recording
from sim_gap.model.load import load_model

POSITIONS, TORQUES = ("position", "velocity", "position_command"), ("torque", "motor_torque", "torque_command")


@pytest.fixture(scope="module")
def arms(realdata: Path):
    """Nominal arm and recording of real arms, by the folder of their recordings."""

    def loaded(folder: str, file: str):
        recording = load_recording(realdata / folder / file)
        return load_model(realdata / folder / "sim.xml", (), recording.n).arm, recording

    files = {"ur10e": "train_a.csv.gz", "ur10": "recording.csv.gz", "tx40": "recording.csv.gz"}
    return {folder: loaded(folder, file) for folder, file in files.items()}


def in_order(recording: Recording, order: list[int], channels: tuple[str, ...]) -> Recording:
    values = {name: getattr(recording, name) for name in channels}
    return replace(recording, **{name: x[:, order] for name, x in values.items() if x is not None})


@pytest.mark.sample(1)
@pytest.mark.parametrize("channels", [POSITIONS, TORQUES, POSITIONS + TORQUES], ids=["positions", "torques", "all"])
def test_any_order_is_put_right(arms, channels):
    arm, recording = arms["ur10e"]
    order = np.random.default_rng(1).permutation(recording.n).tolist()
    checked, found = check_recording(arm, in_order(recording, order, channels), "r", AS_IT_IS)
    assert {each.finding for each in found} == {"order"}
    np.testing.assert_allclose(checked.position, recording.position)
    np.testing.assert_allclose(checked.motor_torque, recording.motor_torque)


@pytest.mark.long
@pytest.mark.parametrize("order", [[1, 2, 5, 0, 4, 3], [0, 5, 1, 4, 2, 3]])
def test_another_order_is_no_angle_in_degrees(arms, order):
    """As degrees, positions of another order hardly move: then friction and a rotor explain most of what is read."""
    arm, recording = arms["tx40"]
    found = check_recording(arm, in_order(recording, order, POSITIONS + TORQUES), "r", AS_IT_IS)[1]
    assert {each.finding for each in found} == {"order"}


def test_an_order_is_told_although_gravity_does_not_load_the_first_joint(arms):
    """Its column, and that of a wrist, are told by little."""
    arm, recording = arms["ur10"]
    checked, _ = check_recording(arm, in_order(recording, [4, 0, 2, 3, 1, 5], POSITIONS + TORQUES), "r", AS_IT_IS)
    np.testing.assert_allclose(checked.position, recording.position)
    np.testing.assert_allclose(checked.motor_torque, recording.motor_torque)


def test_the_plainest_of_orders_that_explain_as_much_is_taken(arms):
    """The last two joints of this arm read friction alone, so that nothing tells them from each other."""
    arm, recording = arms["ur10"]
    checked, found = check_recording(arm, in_order(recording, [0, 1, 3, 2, 4, 5], POSITIONS + TORQUES), "r", AS_IT_IS)
    assert [each.finding for each in found] == ["order"]
    np.testing.assert_allclose(checked.position, recording.position)
