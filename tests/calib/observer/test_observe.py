"""`armlink.observe`: a recording through the observer, with what was found now or kept as records."""

from types import SimpleNamespace

import numpy as np
import pytest

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from calib import api
from calib.fit.gravity_fit import GravityFit
from calib.fit.sensor_fit import SensorFit

ARM = SimpleNamespace(
    name="test", joint_names=("joint_1",), require_link=lambda: SimpleNamespace(rated_torques=np.array([10.0]))
)


class Observer:
    """Says one thing a row."""

    rows = 3

    def handle(self, t: float, position: np.ndarray, torque: np.ndarray) -> list[str]:
        return [f"{t:g} {torque[0]:g}"]

    def estimate(self) -> SimpleNamespace:
        one = np.ones(1)
        return SimpleNamespace(gain=one, gain_std=0.01 * one, offset=0.0 * one, offset_std=0.1 * one)


@pytest.mark.parametrize("fitted", [True, False])
def test_fits_become_records_of_the_arm_and_records_are_checked_to_be_its_own(monkeypatch, fitted: bool) -> None:
    asked: list[tuple] = []

    def observer_of(arm, calibration, gravity, rated, config):
        asked.append((calibration, gravity, rated.tolist()))
        return Observer()

    monkeypatch.setattr(api, "_arm", lambda arm: ARM)
    monkeypatch.setattr(api, "gcomp_arm", lambda arm: None)
    monkeypatch.setattr(api, "observer_of", observer_of)
    monkeypatch.setattr(SensorFit, "record", lambda self, arm: "calibration")
    monkeypatch.setattr(GravityFit, "record", lambda self, arm, calibration: f"gravity by {calibration}")
    sensors, gravity = object.__new__(SensorFit), object.__new__(GravityFit)
    if not fitted:
        sensors = SimpleNamespace(require=lambda arm: "kept calibration")
        gravity = SimpleNamespace(carrying=lambda arm: "kept gravity")
    t = np.arange(3.0)
    run = Recording(t=t, position=np.zeros((3, 1)), torque=5.0 + t[:, None])
    found = api.observe("test", run, gravity, sensors)
    expected = ("calibration", "gravity by calibration") if fitted else ("kept calibration", "kept gravity")
    assert asked == [(*expected, [10.0])]
    assert found.events == ["0 5", "1 6", "2 7"]
    with pytest.raises(BadInput, match="no torque sensor readings"):
        api.observe("test", Recording(t=t, position=np.zeros((3, 1))), gravity, sensors)
