"""The model with the effects added: MuJoCo then gives the torque that the recording shows."""

import numpy as np
import pytest
from wrong_arms import THREE, Wrong, record

from sim_gap.closed import write_model
from sim_gap.diagnose import diagnose
from sim_gap.model import load_model

CASES = {
    "payload": Wrong(payload=0.8),
    "moved mass": Wrong(moved={1: (0.02, 0.02, 0.0)}),
    "rotor and friction": Wrong(rotor=np.array([0.8, 0.0, 0.0]), viscous=np.array([0.0, 1.0, 0.0])),
    "tilt": Wrong(tilt=(0.03, 0.02)),
    "spring": Wrong(spring=np.array([0.0, 2.0, 0.0])),
}


@pytest.mark.parametrize("name", CASES)
def test_the_written_model_has_no_gap_any_more(tmp_path, name):
    (tmp_path / "arm.xml").write_text(THREE)
    nominal = load_model(tmp_path / "arm.xml")
    train, other = (
        record(nominal.mujoco_model, CASES[name], seed=s, seconds=30, noise=0.002, channels=("tau_motor",))
        for s in (1, 2)
    )
    answer = diagnose(tmp_path / "arm.xml", [train], [other])
    assert write_model(nominal, answer.internals.estimate, tmp_path / "closed.xml") == []
    closed = diagnose(tmp_path / "closed.xml", [other], [train])
    assert closed.verdict == "no_gap"
    assert np.all(closed.heldout_before < 0.1 * answer.heldout_before.max() + 0.02)
    assert answer.rollout.after.max() < 0.2 * answer.rollout.before.max()
