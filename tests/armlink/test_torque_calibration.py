"""Gain and offset as one value: apply, invert, compose, of one joint and of all."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlink.link.types import Calibration
from armlink.torque_calibration import UNCALIBRATED, UNKNOWN, TorqueCalibration, per_joint

GAINS = st.floats(0.5, 2.0) | st.floats(-2.0, -0.5)
TORQUES = st.floats(-200.0, 200.0)
CALIBRATIONS = st.builds(TorqueCalibration, GAINS, TORQUES)


@given(CALIBRATIONS, TORQUES)
def test_invert_takes_back_what_apply_does(calibration: TorqueCalibration[float], torque: float) -> None:
    assert calibration.invert(calibration.apply(torque)) == pytest.approx(torque, abs=1e-9)


@given(CALIBRATIONS, CALIBRATIONS, TORQUES)
def test_a_composed_calibration_is_one_after_the_other(
    held: TorqueCalibration[float], change: TorqueCalibration[float], torque: float
) -> None:
    """The controller sends change(τ) with the old calibration, and τ with the new one."""
    new = held.compose(change)
    reading = held.apply(change.apply(torque))
    assert new.apply(torque) == pytest.approx(reading, abs=1e-9)
    assert held.invert(reading) == pytest.approx(change.apply(torque), abs=1e-9)
    assert new.invert(reading) == pytest.approx(torque, abs=1e-9)


@given(CALIBRATIONS, CALIBRATIONS)
def test_relative_to_is_the_inverse_of_compose(old: TorqueCalibration[float], new: TorqueCalibration[float]) -> None:
    again = old.compose(new.relative_to(old))
    assert (again.gain, again.offset) == (pytest.approx(new.gain), pytest.approx(new.offset, abs=1e-9))


def test_arrays_go_joint_by_joint_and_nan_passes_through() -> None:
    both = per_joint([TorqueCalibration(2.0, 1.0), UNKNOWN])
    torque = np.array([[3.0, 1.0], [-1.0, 0.0]])
    np.testing.assert_array_equal(both.apply(torque), [[7.0, np.nan], [-1.0, np.nan]])
    np.testing.assert_array_equal(both.invert(both.apply(torque))[:, 0], torque[:, 0])
    np.testing.assert_array_equal(per_joint([UNCALIBRATED] * 2).apply(torque), torque)


def test_real32_matches_what_it_came_from_and_nothing_else() -> None:
    wanted = TorqueCalibration(1.1, -0.4)
    assert wanted.matches(TorqueCalibration(float(np.float32(1.1)), float(np.float32(-0.4))))
    assert not wanted.matches(TorqueCalibration(1.1001, -0.4))
    assert not wanted.matches(TorqueCalibration(1.1, -0.401))
    assert not UNKNOWN.matches(wanted)
    assert not wanted.matches(UNKNOWN)


def test_a_controller_without_a_record_is_blank() -> None:
    assert Calibration(1.0, 0.0).is_blank
    assert not Calibration(1.0, 0.0, record_id=7).is_blank
    assert not Calibration(1.1, 0.0).is_blank
