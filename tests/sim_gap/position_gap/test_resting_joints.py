"""A joint whose command never moves in what is fitted: nothing is known of it, and it spoils nothing."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, search_on, written

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.model.load import load_model
from sim_gap.position_gap.plant import MovedModel
from sim_gap.position_gap.start import HOLDS_HZ, rests, starting_fit
from sim_gap.position_gap.windows import windows_of

GAIN, MODEL_GAIN = 15.0, 120.0


@pytest.fixture(scope="module")
def answer(tmp_path_factory) -> Diagnosis:
    real = model_text(kp=GAIN, friction=0.15)
    folder: Path = tmp_path_factory.mktemp("arm")
    sim = written(folder, model_text(kp=MODEL_GAIN, friction=0.0))
    return diagnose(sim, [still(record(real, 1, 24.0))], [record(real, 2, 18.0)])


def still(recording: Recording) -> Recording:
    """The elbow held where it is at first, as friction may hold it."""
    assert recording.position_command is not None
    command, position = recording.position_command.copy(), recording.position.copy()
    command[:, 1], position[:, 1] = command[0, 1], position[0, 1]
    return replace(recording, position_command=command, position=position)


@pytest.mark.long
def test_its_values_are_the_models_and_a_note_says_so(answer: Diagnosis) -> None:
    fit = answer.internals.fit
    assert fit.at(1) == ()
    assert fit.point["kp"][1] == MODEL_GAIN
    assert fit.point["coulomb"][1] == 0.0
    assert all("elbow" not in joint for cause in answer.causes for joint in cause.joints)
    (note,) = [note for note in answer.notes if "moves these joints" in note]
    assert note.startswith("elbow: no training recording moves these joints")


@pytest.mark.long
def test_nothing_is_said_of_limits_that_its_motion_does_not_reach(answer: Diagnosis) -> None:
    assert {each.joint for each in answer.internals.spread.limits} == {0}
    assert not any("does not reach" in note and "elbow" in note for note in answer.notes)


def test_a_joint_rests_by_its_command_and_one_without_a_command_does_not() -> None:
    text = model_text(kp=GAIN, friction=0.15)
    whole = record(text, 1, 14.0)
    held, loose = still(whole), still(whole)
    loose.position_command[:, 1] = np.nan
    plant = MovedModel(load_model(mujoco.MjModel.from_xml_string(text)))
    for recording, expected in ((whole, False), (held, True), (loose, False)):
        assert rests(windows_of(plant, [recording], ["run"])).tolist() == [False, expected]


@pytest.mark.long
def test_the_other_joint_is_told_as_well_as_if_there_were_no_such(answer: Diagnosis) -> None:
    fit = answer.internals.fit
    assert fit.point["kp"][0] == pytest.approx(GAIN, rel=0.02)
    assert fit.at(-1) == ()
    assert answer.heldout_after[0] < 0.03 * answer.heldout_before[0]
    assert np.isfinite(answer.band.width).all()


@pytest.mark.long
def test_the_exported_model_moves_and_the_resting_joint_as_before(answer: Diagnosis) -> None:
    """With 36,000 N·m/rad, which held the elbow as well, it flew apart."""
    assert answer.rollout.after[0] < 0.03 * answer.rollout.before[0]
    assert answer.rollout.after[1] == pytest.approx(answer.rollout.before[1], rel=0.05)


def test_a_model_without_servos_gets_one_that_holds_the_resting_joint_and_moves_nothing() -> None:
    """A gripper that stays open in all episodes had 1.8 MN·m/rad, with which the written model shook its arm."""
    text = model_text(kp=GAIN, friction=0.15)
    bare = text[: text.index("<actuator>")] + "</mujoco>"
    search = search_on(bare.replace('frictionloss="0.15"', ""), [still(record(text, 1, 18.0))])
    search = replace(search, excluded=frozenset({"actuator.back_emf"}))
    search, fit = starting_fit(search, lambda text: None)
    assert search.resting == {1}
    assert search.open_controller
    assert fit.at(1) == ()
    inertia = search.scales.inertia[1]
    assert np.sqrt(fit.point["kp"][1] / inertia) / (2.0 * np.pi) == pytest.approx(HOLDS_HZ)
    assert fit.point["viscous"][1] == pytest.approx(2.0 * np.sqrt(fit.point["kp"][1] * inertia))
    assert fit.point["kp"][0] == pytest.approx(GAIN, rel=0.1)
