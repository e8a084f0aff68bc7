"""Hysteresis of a torque sensor that sets in abruptly, as a play, and gradually, as a strain gauge."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model import forward_effects
from sim_gap.effects import sensor_nonlinearity

WIDTH = 0.8


def stays_behind(torque: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Mean of plays of these half widths (Prandtl-Ishlinskii)."""
    at, out = np.full(len(halves), torque[0]), np.empty_like(torque)
    for k, now in enumerate(torque):
        at = np.clip(at, now - halves, now + halves)
        out[k] = at.mean()
    return out


@pytest.mark.parametrize("halves", [np.array([WIDTH]), np.linspace(0.0, 2.0 * WIDTH, 40)], ids=["abrupt", "gradual"])
def test_the_width_is_found_however_it_sets_in(halves):
    lagging = []
    for seed in (1, 2):
        made = record(model(), Wrong(), seed, 40.0, 50.0)
        torque = made.torque.copy()
        torque[:, 1] = stays_behind(torque[:, 1], halves)
        lagging.append(replace(made, torque=torque))
    answer = diagnose(model(), lagging[:1], lagging[1:])
    assert answer.causes[0].effect == "torque.hysteresis"
    found = answer.causes[0].parameters["joint_2"]["width"]
    assert found.value == pytest.approx(WIDTH, rel=0.05)
    assert found.low < WIDTH < found.high


def test_the_written_module_has_the_same_plays():
    assert forward_effects.GRADUAL == sensor_nonlinearity.GRADUAL
