"""The diagnosis of arms with known imperfections: correct effect, joint and parameter; no cause for a sound arm."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.search.model_selection import first_of_each
from sim_gap.search.term import Term

BOTH, MOTOR = ("tau", "tau_motor"), ("tau_motor",)


def at(joint: int, value: float, other: float = 0.0) -> np.ndarray:
    return np.array([value if j == joint else other for j in range(3)])


ANSWERS: dict[str, Diagnosis] = {}
"""Those that more than one test asks for, by what they are of."""


def diagnosed(wrong: Wrong, channels=BOTH, **options) -> Diagnosis:
    key = repr((wrong, channels, options))
    if key not in ANSWERS:
        train, other = (record(model(), wrong, seed=s, seconds=t, channels=channels) for s, t in ((1, 40), (2, 25)))
        ANSWERS[key] = diagnose(model(), [train], [other], **options)
    return ANSWERS[key]


def value(answer: Diagnosis, place: str, name: str) -> float:
    return answer.causes[0].parameters[place][name].value


SINGLE = [
    ("friction.coulomb", "joint_2", "torque", 0.8, Wrong(coulomb=at(1, 0.8)), BOTH),
    ("friction.viscous", "joint_1", "damping", 2.0, Wrong(viscous=at(0, 2.0)), MOTOR),
    ("friction.stribeck", "joint_2", "breakaway", 1.0, Wrong(breakaway=at(1, 1.0)), BOTH),
    ("friction.load", "joint_1", "coefficient", 0.08, Wrong(load=at(0, 0.08)), BOTH),
    ("torque.gain", "joint_2", "gain", 1.1, Wrong(gain=at(1, 1.1, 1.0)), BOTH),
    ("torque.offset", "joint_3", "offset", 0.5, Wrong(offset=at(2, 0.5)), BOTH),
    ("actuator.gain", "joint_1", "gain", 1.1, Wrong(motor_gain=at(0, 1.1, 1.0)), BOTH),
    ("actuator.rotor_inertia", "joint_1", "inertia", 0.8, Wrong(rotor=at(0, 0.8)), BOTH),
    ("transmission.spring", "joint_2", "stiffness", 2.0, Wrong(spring=at(1, 2.0)), BOTH),
    ("position.offset", "joint_2", "offset", 0.05, Wrong(position_offset=at(1, 0.05)), BOTH),
    ("link.mass_moment", "joint_2", "x", 0.06, Wrong(moved={1: (0.02, 0.02, 0.0)}), MOTOR),
    ("link.payload", "arm", "mass", 0.8, Wrong(payload=0.8), MOTOR),
    ("base.tilt", "arm", "angle_1", 0.03, Wrong(tilt=(0.03, 0.02)), BOTH),
]


@pytest.mark.sample(2)
@pytest.mark.parametrize(("effect", "place", "name", "truth", "wrong", "channels"), SINGLE)
def test_one_effect_is_named_first_with_its_joint_and_size(effect, place, name, truth, wrong, channels):
    answer = diagnosed(wrong, channels)
    assert answer.verdict == "explained"
    assert answer.causes[0].effect == effect
    assert place in (*answer.causes[0].joints, "arm")
    assert value(answer, place, name) == pytest.approx(truth, rel=0.05)
    assert np.all(answer.heldout_after <= np.maximum(0.1 * answer.heldout_before, 2 * answer.noise_floor))
    assert answer.unexplained < 0.02


@pytest.mark.long
def test_the_same_effect_on_several_joints_is_one_cause():
    answer = diagnosed(Wrong(coulomb=np.array([0.5, 0.6, 0.7])))
    assert [cause.effect for cause in answer.causes] == ["friction.coulomb"]
    assert answer.causes[0].joints == ("joint_1", "joint_2", "joint_3")


def test_two_effects_on_different_sides_are_both_found():
    answer = diagnosed(Wrong(coulomb=at(1, 0.8), gain=at(0, 1.08, 1.0)))
    assert {cause.effect for cause in answer.causes if cause.confidence > 0.8} == {"friction.coulomb", "torque.gain"}


@pytest.mark.long
def test_ripple_of_many_teeth_is_found_where_the_joint_turns_slowly_enough():
    """A harmonic drive of ratio 100: two waves a turn of the motor, 32 a radian of the joint."""
    answer = diagnosed(Wrong(ripple=at(1, 0.6), cycles=100 / np.pi))
    assert answer.causes[0].effect == "transmission.ripple"
    assert value(answer, "joint_2", "cycles") == pytest.approx(100 / np.pi, rel=0.01)
    assert value(answer, "joint_2", "amplitude") == pytest.approx(0.6, rel=0.1)


@pytest.mark.sample(1)
@pytest.mark.parametrize("channels", [BOTH, MOTOR])
def test_a_true_model_has_no_gap(channels):
    answer = diagnosed(Wrong(), channels)
    assert (answer.verdict, answer.causes) == ("no_gap", ())


@pytest.mark.long
def test_an_effect_that_was_withheld_is_not_blamed_on_another_with_confidence():
    answer = diagnosed(Wrong(ripple=at(1, 0.6)), withhold=["transmission.ripple"])
    assert answer.verdict == "unexplained" or not [c for c in answer.causes if c.confidence > 0.8]


@pytest.mark.long
def test_noise_in_the_motion_that_no_effect_makes_is_unexplained():
    def shaken(recording: Recording) -> Recording:
        wave = 1.5 * np.sin(2 * np.pi * 1.37 * recording.t + np.sin(0.9 * recording.t))
        torque = recording.torque + wave[:, None] * [0, 1, 0]
        return Recording(t=recording.t, position=recording.position, torque=torque, motor_torque=recording.motor_torque)

    recordings = [shaken(record(model(), Wrong(), seed=seed, seconds=40)) for seed in (1, 2)]
    assert diagnose(model(), recordings[:1], recordings[1:]).verdict == "unexplained"


@pytest.mark.long
def test_a_slow_channel_between_the_rows_of_a_fast_one_is_used():
    def thin(recording: Recording) -> Recording:
        motor = recording.motor_torque.copy()
        motor[np.arange(len(motor)) % 4 > 0] = np.nan
        return Recording(t=recording.t, position=recording.position, torque=recording.torque, motor_torque=motor)

    recordings = [thin(record(model(), Wrong(coulomb=np.full(3, 0.5)), seed=s, seconds=40)) for s in (1, 2)]
    answer = diagnose(model(), recordings[:1], recordings[1:])
    assert answer.verdict == "explained"
    assert answer.causes[0].effect == "friction.coulomb"
    assert len(answer.causes[0].joints) == 3


@pytest.mark.long
def test_without_other_motion_the_end_of_the_recording_is_kept_for_judging():
    answer = diagnose(model(), [record(model(), Wrong(coulomb=at(1, 0.8)), seconds=60)])
    assert answer.causes[0].effect == "friction.coulomb"
    assert "last 30%" in answer.heldout_is


def test_the_json_has_the_documented_keys():
    answer = diagnosed(Wrong(coulomb=at(1, 0.8))).to_json()
    assert answer["schema"] == "armlink.gap/2"
    assert set(answer) >= {"verdict", "where", "causes", "gap", "rollout", "unexplained"}
    assert set(answer["where"][0]) == {"joint", "channel", "regime", "rms", "noise", "share"}
    cause = answer["causes"][0]
    wanted = {"effect", "joints", "parameters", "gap_before", "gap_after", "shrink", "confidence"}
    assert set(cause) == wanted | {"confounded_with", "separate_by"}
    torque = cause["parameters"]["joint_2"]["torque"]
    assert torque["ci95"][0] < torque["value"] < torque["ci95"][1]
    assert torque["unit"] == "N·m"
    assert len(answer["gap"]["heldout"]["after"]) == 3
    assert set(answer["rollout"]) == {"unit", "horizon_s", "closed_loop", "before", "after", "effects"}
    (alone,) = answer["rollout"]["effects"]
    assert (alone["effect"], alone["joints"]) == ("friction.coulomb", ["joint_2"])
    assert alone["alone"][1] < 0.3 * alone["without"][1]
    assert answer["rollout"]["after"][1] < 0.3 * answer["rollout"]["before"][1]
    assert answer["where"][0]["joint"] == "joint_2"
    assert answer["where"][0]["regime"] == "velocity"


@pytest.mark.long
def test_an_offset_of_the_last_joints_angle_is_not_passed_off_as_its_mass_moment():
    """Both make the same torque but for the motion's dynamics; at 0.12 rad the offset's tangent is not the offset."""
    wrong = Wrong(position_offset=np.array([0.0, 0.0, 0.12]))
    recordings = [record(model(), wrong, seed=seed, seconds=40, rate=50.0) for seed in (1, 2)]
    first = diagnose(model(), recordings[:1], recordings[1:]).causes[0]
    assert "position.offset" in {first.effect, *first.confounded_with}


@pytest.mark.long
def test_where_the_sensors_drown_in_noise_the_command_is_compared_with_the_model():
    def noisy(seed: int) -> Recording:
        clean = record(model(), Wrong(coulomb=np.array([0.0, 0.8, 0.0])), seed=seed, seconds=40, rate=50.0)
        noise = 40.0 * np.random.default_rng(seed).normal(size=(2, *clean.torque.shape))
        shaken = {"torque": clean.torque + noise[0], "motor_torque": clean.motor_torque + noise[1]}
        return replace(clean, torque_command=clean.motor_torque, **shaken)

    answer = diagnose(model(), [noisy(1)], [noisy(2)])
    assert "is too large" in answer.notes[0]
    assert (answer.causes[0].effect, answer.causes[0].joints) == ("friction.coulomb", ("joint_2",))


def test_two_shapes_of_one_effect_at_one_place_become_one():
    two = [Term("transmission.coupling", 2, (2.0, lever)) for lever in (-1.0, -0.6)]
    friction = Term("friction.coulomb", 0)
    assert set(first_of_each([two[0], friction, two[1]])) == {two[0], friction}
