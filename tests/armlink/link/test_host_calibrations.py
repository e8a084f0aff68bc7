"""Calibrations that the host applies: which joints have none is said, and of a simulated arm nothing."""

from types import SimpleNamespace

import pytest

from armlink.link.joints import calibrations
from armlink.link.joints.calibrations import BLANK_CALIBRATION, Calibrations
from armlink.torque_calibration import Calibration

FOUND = [None, None, Calibration(1.1, 0.2, record_id=7)]


@pytest.mark.parametrize("simulated", [False, True])
@pytest.mark.parametrize("serial", ["SN-1", "unknown"])
def test_joints_without_a_record_and_records_without_a_serial_are_named(simulated, serial, monkeypatch, caplog):
    traits = [SimpleNamespace(calibration=by) for by in ("host", "drive", "host")]
    monkeypatch.setattr(calibrations, "traits_of", lambda groups: traits)
    monkeypatch.setattr(calibrations, "calibrations_by_record", lambda arm: FOUND)
    joints = SimpleNamespace(
        arm=SimpleNamespace(name="three", serial=serial, has_serial=serial != "unknown"),
        n=3,
        groups=(),
        names=("a", "b", "c"),
        _apply_host=lambda: None,
    )
    Calibrations.calibrate_host(joints, simulated)
    assert joints._in_host == {0: BLANK_CALIBRATION, 2: BLANK_CALIBRATION if simulated else FOUND[2]}
    said = [record.getMessage() for record in caplog.records]
    if simulated:
        assert said == []
        return
    assert said[0].startswith("three: there is no current calibration record for a: their torques")
    assert [text.partition(", so the calibration")[0] for text in said[1:]] == (
        ["three: its serial is unknown"] if serial == "unknown" else []
    )
