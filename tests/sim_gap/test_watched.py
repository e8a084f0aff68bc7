"""What is watched of every joint: a play too small to be a cause, friction and gains, with or without a gap."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.trends import WATCHED, watched_parameters

SMALL = np.radians(0.1)


def of(wrong: Wrong, **options) -> dict[tuple[str, str], float]:
    answer = diagnose(model(), [record(model(), wrong, 7, seconds=20.0, rate=50.0, **options)])
    assert "transmission.backlash" not in {cause.effect for cause in (*answer.causes, *answer.minor)}
    return {(one["effect"], one["joint"]): one["value"] for one in watched_parameters(answer)}


@pytest.mark.long
def test_a_play_that_no_answer_names_is_seen():
    worn = Wrong(coulomb=1.0, viscous=0.8, gain=1.1)
    before, after = of(worn), of(replace(worn, play=np.array([SMALL, 0.0, 0.0])))
    change = {key: after[key] - before[key] for key in before}
    assert change["transmission.backlash", "joint_1"] == pytest.approx(SMALL, rel=0.2)
    assert abs(change["transmission.backlash", "joint_2"]) < 0.2 * SMALL
    assert before["friction.coulomb", "joint_3"] == pytest.approx(1.0, rel=0.02)
    assert before["torque.gain", "joint_2"] == pytest.approx(1.1, rel=0.005)


def test_a_sound_arm_is_watched_as_far_as_its_channels_show():
    found = of(Wrong(), channels=("tau_motor",))
    assert {effect for effect, _ in found} == {*WATCHED} - {"torque.gain"}
    assert all(abs(found["friction.coulomb", f"joint_{j}"]) < 0.01 for j in (1, 2, 3))
