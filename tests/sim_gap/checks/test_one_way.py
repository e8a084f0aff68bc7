"""Of motion that goes one way no column is judged by the model, and the diagnosis says so."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import model

from armlink.recording.corrections import AS_IT_IS
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.checks.check import check_recording, goes_one_way, unchecked_note
from sim_gap.model.load import load_model

SECONDS, RATE = 8.0, 100.0
FROM, TO = np.array([-1.2, 0.9, -0.6]), np.array([0.8, -0.7, 1.1])


def strokes(count: float, noise: float = 0.0) -> Recording:
    """So many smooth strokes between two poses with a second of rest at either end, and the link torques there."""
    arm, random = load_model(model()).arm, np.random.default_rng(1)
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    phase = np.pi * count * np.clip((t - 1.0) / (SECONDS - 2.0), 0.0, 1.0)
    q = FROM + (TO - FROM) * (0.5 - 0.5 * np.cos(phase))[:, None]
    v = np.gradient(q, t, axis=0)
    torque = arm.torque(q, v, np.gradient(v, t, axis=0)) + 0.02 * random.normal(size=q.shape)
    return Recording(t=t, position=q + noise * random.normal(size=q.shape), torque=torque)


@pytest.mark.parametrize(("count", "one_way"), [(0.0, True), (1.0, True), (1.3, True), (2.0, False), (3.0, False)])
def test_a_single_stroke_goes_one_way(count: float, one_way: bool):
    for noise in (0.0, 3e-4):
        assert goes_one_way(strokes(count, noise)) == one_way


def test_columns_are_not_judged_by_a_single_stroke():
    recording = strokes(1.0)
    exchanged = replace(recording, torque=20.0 * recording.torque[:, [0, 2, 1]])
    assert check_recording(load_model(model()).arm, exchanged, "r.csv", AS_IT_IS)[1] == []


def test_the_diagnosis_says_what_was_not_checked():
    (note,) = unchecked_note([strokes(1.0)])
    assert "record motion in both directions" in note
    assert unchecked_note([strokes(1.0), strokes(3.0)]) == ()
    assert note in diagnose(model(), [strokes(1.0)]).notes
