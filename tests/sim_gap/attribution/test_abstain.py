"""Where no effect of the library is the reason, nothing is blamed: `unexplained`, and a word on what is odd."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.model.load import load_model
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet, near_impacts

Odd = Callable[[Recording], Recording]


def diagnosed(odd: Odd, wrong: Wrong | None = None) -> Diagnosis:
    recordings = [odd(record(model(), wrong or Wrong(), seed=seed, seconds=40, rate=50.0)) for seed in (1, 2)]
    return diagnose(model(), recordings[:1], recordings[1:])


def pushed(force: Callable[[np.ndarray], np.ndarray]) -> Odd:
    """A force from outside on joints 1 and 2, felt by sensor and motor alike."""

    def odd(recording: Recording) -> Recording:
        extra = force(recording.t)[:, None] * [0.6, 1.0, 0.0]
        torque, motor = recording.torque + extra, recording.motor_torque + extra
        return replace(recording, torque=torque, motor_torque=motor)

    return odd


def knock(t: np.ndarray) -> np.ndarray:
    return 8.0 * np.exp(-(((t - 12.0) / 0.1) ** 2)) - 6.0 * np.exp(-(((t - 25.0) / 0.1) ** 2))


def leaning(t: np.ndarray) -> np.ndarray:
    return np.where((t > 15) & (t < 19), 3.0 * np.sin(np.pi * (t - 15) / 4), 0.0)


def machine_beside(t: np.ndarray) -> np.ndarray:
    return 1.5 * np.sign(np.sin(2 * np.pi * 0.4 * t))


@pytest.mark.sample(1)
@pytest.mark.parametrize("force", [knock, leaning, machine_beside])
def test_a_force_from_outside_is_blamed_on_nothing(force):
    answer = diagnosed(pushed(force))
    assert answer.verdict == "unexplained"
    assert not [cause for cause in answer.causes if cause.confidence > 0.5]
    assert any(note.startswith("joint_2: ") and "remains (noise" in note for note in answer.notes)


@pytest.mark.long
def test_a_hum_below_the_pass_band_is_blamed_on_nothing():
    hum = lambda r: replace(r, torque=r.torque + np.sin(2 * np.pi * 2.1 * r.t)[:, None] * [0, 1, 0])  # noqa: E731
    answer = diagnosed(hum)
    assert answer.verdict == "unexplained"
    assert not answer.causes


@pytest.mark.long
def test_mains_hum_above_the_pass_band_is_a_band_and_blames_nothing():
    hum = lambda r: replace(r, torque=r.torque + np.sin(2 * np.pi * 18.7 * r.t)[:, None] * [0, 1, 0])  # noqa: E731
    answer = diagnosed(hum)
    assert answer.verdict == "unexplained"
    (line,) = [place for place in answer.where if place.regime == "band"]
    assert (line.joint, line.channel) == ("joint_2", "tau")
    assert line.hz == pytest.approx(18.7, abs=0.3)
    assert not [cause for cause in answer.causes if cause.confidence > 0.5]


def stuck(recording: Recording) -> Recording:
    torque = recording.torque.copy()
    torque[recording.t > 15, 1] = torque[np.argmax(recording.t > 15), 1]
    return replace(recording, torque=torque)


def dead(recording: Recording) -> Recording:
    torque = recording.torque.copy()
    torque[:, 1] = 1.234
    return replace(recording, torque=torque)


@pytest.mark.sample(1)
@pytest.mark.parametrize("odd", [stuck, dead])
def test_a_stuck_sensor_is_named_and_blames_no_effect(odd):
    answer = diagnosed(odd)
    assert answer.verdict == "unexplained"
    assert not answer.causes
    assert "joint_2: tau repeats one value" in answer.notes[0]


@pytest.mark.parametrize(("held", "channels"), [(True, ["tau"]), (False, ["tau", "tau_motor"])])
def test_the_motor_of_a_joint_that_is_held_may_repeat_one_number_its_sensor_may_not(held, channels):
    """While other joints move, the load of a held joint changes; friction takes it up instead of the motor."""
    moving = record(model(), Wrong(), seed=1, seconds=40, rate=50.0)
    position, torque, motor = (x.copy() for x in (moving.position, moving.torque, moving.motor_torque))
    if held:
        position[:, 1] = 0.3
    torque[:, 1] = motor[:, 1] = 1.234
    recording = replace(moving, position=position, torque=torque, motor_torque=motor)
    signals = prepare(recording, load_model(model(), (), 3).arm)
    assert [(one.channel, one.joint) for one in signals.stuck] == [(channel, 1) for channel in channels]


@pytest.mark.long
def test_beside_a_stuck_sensor_other_joints_are_still_read():
    answer = diagnosed(dead, Wrong(coulomb=np.array([0.8, 0.0, 0.0])))
    assert answer.causes[0].effect == "friction.coulomb"
    assert answer.causes[0].joints == ("joint_1",)
    assert answer.causes[0].confidence <= 0.5


@pytest.mark.long
def test_friction_that_the_library_has_not_is_no_viscous_friction_for_sure():
    def drag(recording: Recording) -> Recording:
        v = np.gradient(recording.position, recording.t, axis=0)
        return replace(recording, motor_torque=recording.motor_torque + np.abs(v) * v * [0, 6, 0])

    assert not [cause for cause in diagnosed(drag).causes if cause.confidence > 0.8]


def test_a_gear_that_hits_is_seen_where_its_torque_changes_sign():
    recording = record(model(), Wrong(), seed=3, seconds=30)
    near = np.zeros(len(recording.t))
    for k in np.flatnonzero(np.diff(np.sign(recording.torque[:, 1] - np.median(recording.torque[:, 1])))):
        near += np.exp(-(((recording.t - recording.t[k]) / 0.04) ** 2))
    shifted = recording.torque - [0, float(np.median(recording.torque[:, 1])), 0]
    struck = replace(recording, torque=shifted + np.clip(near, 0, 1)[:, None] * [0, 5, 0])
    for one, joints in ((struck, {1}), (replace(recording, torque=shifted), set())):
        signals = prepare(one, load_model(model()).arm)
        data = ResidualSet((signals,), layout_of([signals]))
        residual = np.stack([data.values["tau", j] for j in range(3)], axis=1)
        assert set(near_impacts(signals, "tau", residual)) == joints
