"""Friction in a recording whose times are those of receipt."""

from dataclasses import replace

import numpy as np
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose


def test_friction_is_found_under_five_milliseconds_of_jitter() -> None:
    clean = record(model(), Wrong(coulomb=np.array([0.5, 0.8, 0.4])), 1, seconds=20.0, rate=100.0)
    late = np.abs(np.random.default_rng(1).normal(0.0, 0.005, len(clean.t)))
    received = np.maximum.accumulate(clean.t + late) + 1e-9 * np.arange(len(clean.t))
    found = diagnose(model(), [replace(clean, t=received - received[0])])
    (cause,) = found.causes
    assert cause.effect == "friction.coulomb"
    assert cause.confidence >= 0.8
    assert [check.finding for check in found.checks] == ["jitter"]
