"""A moment in which several joints at once are far off is left out and told; what is the arm's own stays."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.residuals.disregarded_rows import are_far_off, disturbances

RATE = 25.0
TIME = np.arange(0.0, 40.0, 1.0 / RATE)
JUDGED = np.ones((TIME.size, 4), bool)


def found(*knocks: tuple[float, float, int]):
    """Disturbances of four joints, in noise and with knocks: start, length [s], number of joints."""
    left = np.random.default_rng(1).normal(0.0, 0.1, (TIME.size, 4))
    for start, length, joints in knocks:
        left[(start <= TIME) & (start + length > TIME), :joints] += 5.0
    far = np.stack([are_far_off(x, ok, 0.05, 0.3) for x, ok in zip(left.T, JUDGED.T, strict=True)], axis=1)
    return disturbances(TIME, far, JUDGED, left)


def test_a_knock_on_most_joints_is_found_where_it_is():
    (one,) = found((12.0, 0.3, 3))
    assert one.start == pytest.approx(12.0, abs=0.05)
    assert one.end == pytest.approx(12.3, abs=0.05)
    assert one.torque == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize(
    "knocks",
    [
        [(12.0, 0.3, 2)],  # few joints: an effect of theirs
        [(12.0, 1.0, 4)],  # what lasts
        [(5.0 * k, 0.2, 4) for k in range(1, 7)],  # what happens again and again
        [],
    ],
)
def test_what_may_be_the_arms_own_is_no_disturbance(knocks):
    assert found(*knocks) == ()


@pytest.mark.long
def test_the_diagnosis_is_that_of_the_rest_and_says_what_it_left_out():
    wrong = Wrong(coulomb=np.array([0.0, 0.6, 0.0]))
    channels = ("tau_motor",)
    recordings = [record(model(), wrong, seed=k, seconds=30.0, rate=50.0, channels=channels) for k in (1, 2)]
    spoiled = []
    for recording in recordings:
        push = np.exp(-(((recording.t - 14.0) / 0.08) ** 2))[:, None] * [6.0, 9.0, 4.0]
        spoiled.append(replace(recording, motor_torque=recording.motor_torque + push))
    clean, answer = (diagnose(model(), made[:1], made[1:]) for made in (recordings, spoiled))
    assert answer.verdict == clean.verdict == "explained"
    assert [cause.effect for cause in answer.causes] == ["friction.coulomb"]
    before, after = (made.causes[0].parameters["joint_2"]["torque"].value for made in (clean, answer))
    assert after == pytest.approx(before, rel=0.03)
    told = [note for note in answer.notes if "several joints differ suddenly from the fit" in note]
    assert len(told) == 2
    assert all("at 13." in note or "at 14." in note for note in told)
    assert 0.0 < answer.left_out - clean.left_out < 0.05
    assert not any("far off at once" in note for note in clean.notes)
