"""`armlink.diagnose` takes what is stated of columns, as the command does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import wrong_arms

import armlink
from armlink.errors import BadInput
from armlink.recording.files import save_recording


def test_units_signs_and_zeros_are_stated_as_for_the_command(tmp_path: Path) -> None:
    nominal, wrong = wrong_arms.model(), wrong_arms.Wrong(coulomb=np.array([0.0, 2.0, 0.0]))
    run = wrong_arms.record(nominal, wrong, 1, seconds=20.0, rate=50.0)
    other = replace(run, position=np.degrees(run.position - [0.0, 0.0, 0.4]), torque=run.torque * [-1.0, 1.0, 1.0])
    save_recording(other, tmp_path / "other.csv")
    plain = armlink.diagnose(nominal, run)
    for given in (other, tmp_path / "other.csv"):
        stated = armlink.diagnose(nominal, given, units={"q": "deg"}, sign={"tau_1": -1}, zero=["q_3=0.4"])
        assert stated.verdict == plain.verdict == "explained"
        assert [cause.effect for cause in stated.causes] == [cause.effect for cause in plain.causes]
    with pytest.raises(BadInput, match="furlong"):
        armlink.diagnose(nominal, run, units={"q": "furlong"})
