"""Drive errors with noisy sensors: the quietest reference is used, and noise alone is not a gap."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.effects.transmission import transmitted
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.term import Term


def commanded(seed: int, lag: float = 0.0, noise: tuple[float, float] = (0.0, 0.0), share: float = 0.0) -> Recording:
    """A true arm, joint 2's drive following its command with a lag [s]; noise of its sensor and motor estimate.

    `share` [N·m] is noise of a controller, which the drive makes and reports: command and estimate have it in common.
    """
    clean = record(model(), Wrong(), seed=seed, seconds=40)
    random, second = np.random.default_rng(seed), np.array([0.0, 1.0, 0.0])
    made = record(model(), Wrong(), seed=seed, seconds=40, noise=0.0).motor_torque
    command = made + lag * np.gradient(made, clean.t, axis=0) * second
    sensor, motor = (size * random.normal(size=made.shape) * second for size in noise)
    both = share * random.normal(size=made.shape) * second
    return replace(
        clean,
        torque=clean.torque + sensor,
        motor_torque=clean.motor_torque + motor + both,
        torque_command=command + both + 0.01 * random.normal(size=made.shape),
    )


def diagnosed(**wrong) -> Diagnosis:
    return diagnose(model(), [commanded(1, **wrong)], [commanded(2, **wrong)])


def residuals(recording: Recording) -> ResidualSet:
    signals = prepare(recording, load_model(model(), (), 3).arm)
    return ResidualSet((signals,), layout_of([signals]))


@pytest.mark.long
def test_a_lag_far_below_the_noise_of_sensor_and_estimate_is_told_from_the_command_against_the_model():
    answer = diagnosed(lag=0.06, noise=(9.0, 5.0))
    first = answer.causes[0]
    assert "actuator.lag" in {first.effect, *first.confounded_with}
    assert first.joints == ("joint_2",)
    assert first.parameters["joint_2"]["time"].value == pytest.approx(0.06, rel=0.3)
    assert any("joint_2" in note and "the command is compared with the model" in note for note in answer.notes)


@pytest.mark.long
def test_a_lag_within_the_margin_of_its_channel_is_told_where_it_shows_throughout():
    answer = diagnosed(lag=0.03, noise=(0.0, 0.4))
    first = answer.causes[0]
    assert "actuator.lag" in {first.effect, *first.confounded_with}


@pytest.mark.long
def test_the_same_noise_without_a_lag_is_no_gap():
    assert diagnosed(noise=(9.0, 5.0)).verdict == "no_gap"
    assert diagnosed(noise=(0.0, 0.4)).verdict == "no_gap"


def test_noise_that_command_and_estimate_have_in_common_is_no_noise_of_their_difference():
    common, none = residuals(commanded(1, share=3.0)), residuals(commanded(1))
    row = ("tau_cmd", 1)
    assert common.floor[row] == pytest.approx(none.floor[row], rel=0.3)
    assert common.signals[0].noise["tau_cmd"][1] > 20.0 * none.signals[0].noise["tau_cmd"][1]


def test_the_command_is_compared_with_the_motors_estimate_unless_another_is_much_quieter():
    assert [residuals(commanded(1)).layout.beyond(j) for j in range(3)] == [0, 0, 0]
    noisy_motor = residuals(commanded(1, noise=(0.0, 5.0))).layout
    assert [noisy_motor.reference(("tau_cmd", j)) for j in range(3)] == ["tau_motor", "tau", "tau_motor"]
    noisy = residuals(commanded(1, noise=(9.0, 5.0))).layout
    assert [noisy.reference(("tau_cmd", j)) for j in range(3)] == ["tau_motor", None, "tau_motor"]


def test_residuals_and_columns_of_a_command_are_compared_alike():
    """Friction shows in motor less sensor, and in the command's row if that passes over the motor."""
    quiet, noisy = (ColumnStore(residuals(commanded(1, **options))) for options in ({}, {"noise": (9.0, 5.0)}))
    friction = Term("friction.coulomb", 1)
    assert ("tau_cmd", 1) not in quiet.columns(friction)
    columns = noisy.columns(friction)
    np.testing.assert_allclose(columns["tau_cmd", 1], columns["tau_motor", 1])
    assert ("tau_cmd", 0) not in noisy.columns(Term("friction.coulomb", 0))


def test_a_noisy_reading_does_not_explain_itself_as_what_bends_a_gear():
    quiet, noisy = residuals(commanded(1)), residuals(commanded(1, noise=(9.0, 0.0)))
    clear = [transmitted(data.signals[0], data.layout, 1) for data in (quiet, noisy)]
    inner = slice(50, -50)
    assert np.sqrt(np.mean((clear[1] - clear[0])[inner] ** 2)) < 0.2


@pytest.mark.long
def test_a_limit_reached_in_one_stretch_of_the_training_alone_is_told():
    """Without that interval in the fit it is still predicted: above its limit a drive adds no torque."""
    train, heldout = commanded(7), commanded(1)
    high = np.abs(train.motor_torque[:, 1])
    near = np.abs(train.t - train.t[np.argmax(high)]) < 2.0
    limit = high[~near].max()
    assert limit < 0.95 * high.max()
    assert np.abs(heldout.motor_torque[:, 1]).max() > limit

    def beyond(recording: Recording) -> Recording:
        command = recording.torque_command.copy()
        command[:, 1] += 8.0 * np.sign(command[:, 1]) * np.maximum(np.abs(command[:, 1]) - limit, 0.0)
        return replace(recording, torque_command=command)

    first = diagnose(model(), [beyond(train)], [beyond(heldout)]).causes[0]
    assert (first.effect, first.joints) == ("actuator.saturation", ("joint_2",))
    assert first.parameters["joint_2"]["limit"].value == pytest.approx(limit, rel=0.05)
