"""Torque sensors with hysteresis, abrupt as of a play and gradual as of a strain gauge, and with a dead band behind."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis

WIDTH = 0.8


def stays_behind(torque: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Mean of plays of these half widths (Prandtl-Ishlinskii)."""
    at, out = np.full(len(halves), torque[0]), np.empty_like(torque)
    for k, now in enumerate(torque):
        at = np.clip(at, now - halves, now + halves)
        out[k] = at.mean()
    return out


def diagnosed(wrong: Wrong, reads: Callable[[np.ndarray], np.ndarray]) -> Diagnosis:
    """The answer on an arm whose second sensor reads its torque like this."""
    recordings = []
    for seed in (1, 2):
        made = record(model(), wrong, seed, 40.0, 50.0)
        torque = made.torque.copy()
        torque[:, 1] = reads(torque[:, 1])
        recordings.append(replace(made, torque=torque))
    return diagnose(model(), recordings[:1], recordings[1:])


@pytest.mark.sample(1)
@pytest.mark.parametrize("halves", [np.array([WIDTH]), np.linspace(0.0, 2.0 * WIDTH, 40)], ids=["abrupt", "gradual"])
def test_the_width_is_found_however_it_sets_in(halves):
    answer = diagnosed(Wrong(), lambda torque: stays_behind(torque, halves))
    assert answer.causes[0].effect == "torque.hysteresis"
    found = answer.causes[0].parameters["joint_2"]["width"]
    assert found.value == pytest.approx(WIDTH, rel=0.05)
    assert found.low < WIDTH < found.high


@pytest.mark.long
def test_a_dead_band_gets_what_the_hysteresis_passes_on():
    width, band = 0.8, 0.5

    def reads(torque: np.ndarray) -> np.ndarray:
        held = stays_behind(torque, np.array([width]))
        return np.sign(held) * np.maximum(np.abs(held) - band, 0.0)

    answer = diagnosed(Wrong(), reads)
    found = {cause.effect: cause.parameters.get("joint_2", {}) for cause in answer.causes}
    assert set(found) == {"torque.hysteresis", "torque.deadband"}
    assert found["torque.deadband"]["width"].value == pytest.approx(band, rel=0.03)
    assert found["torque.hysteresis"]["width"].value == pytest.approx(width, rel=0.05)
