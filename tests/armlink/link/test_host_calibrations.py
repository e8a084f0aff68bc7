"""Calibrations that the host applies: which joints have none is said, and of a simulated arm nothing."""

from types import SimpleNamespace

import pytest

from armlink.link.joints import calibrations
from armlink.link.joints.calibrations import BLANK, Calibrations
from armlink.torque_calibration import Calibration

FOUND = [None, None, Calibration(1.1, 0.2, record_id=7)]


@pytest.mark.parametrize("simulated", [False, True])
def test_joints_that_the_host_calibrates_and_has_no_record_for_are_named(simulated, monkeypatch, caplog):
    traits = [SimpleNamespace(calibration=by) for by in ("host", "drive", "host")]
    monkeypatch.setattr(calibrations, "traits_of", lambda groups: traits)
    monkeypatch.setattr(calibrations, "calibrations_by_record", lambda arm: FOUND)
    joints = SimpleNamespace(
        arm=SimpleNamespace(name="three"), n=3, groups=(), names=("a", "b", "c"), _apply_host=lambda: None
    )
    Calibrations.calibrate_host(joints, simulated)
    assert joints._in_host == {0: BLANK, 2: BLANK if simulated else FOUND[2]}
    said = [record.getMessage() for record in caplog.records]
    assert [text.partition(": torque")[0] for text in said] == (
        [] if simulated else ["three: no calibration record is in force for a"]
    )
