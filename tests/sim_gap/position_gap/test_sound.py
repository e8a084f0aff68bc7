from dataclasses import replace

import numpy as np
import pytest
from servo_arm import model_text, record, search_on

from sim_gap.position_gap.fit import LoopFit, rms_on
from sim_gap.position_gap.identify import _margin
from sim_gap.position_gap.sound_arm import probable, split_gap
from sim_gap.position_gap.start import noise_floor

NOMINAL = model_text(kp=40.0, friction=0.05)


def split(real: str):
    """The gap of the nominal model against an arm, split, with its margin and the RMS that it has [rad]."""
    search, other = (search_on(NOMINAL, [record(real, seed, 26.0)]) for seed in (1, 2))
    search = replace(search, floor=noise_floor(search.data))
    fit = LoopFit(search.nominal)
    margin = _margin(search, fit)
    return split_gap(search, other.data, margin), margin, rms_on(search.data, fit.point)


def test_errors_of_a_hundredth_are_those_of_a_sound_arm() -> None:
    found, margin, gap = split(model_text(kp=40.4, friction=0.06, damping=0.808))
    assert found.explained
    assert (gap < 3.0 * np.maximum(found.usual, margin)).all()
    assert (found.left < 1.3 * margin).all()


@pytest.mark.long
def test_a_tilt_is_no_error_of_a_sound_arm() -> None:
    """It acts where other poses feel gravity least, as no gain or mass does."""
    found, margin, _ = split(NOMINAL.replace("<option", '<option gravity="2.43 0 -9.5"'))
    assert not found.explained
    assert (found.left > margin).any()


@pytest.mark.long
def test_a_gain_that_is_far_off_is_no_error_of_a_sound_arm() -> None:
    found, _, _ = split(model_text(kp=36.0, friction=0.05))
    assert not found.explained


def test_one_large_error_among_many_small_ones_is_no_error_of_a_sound_arm() -> None:
    """Twenty errors together may have a sum of squares of 37; one by itself may be 3.5 standard deviations large."""
    usually, spread = np.eye(20), 0.2 * np.eye(20)
    small = np.linspace(-1.2, 1.2, 20)
    assert probable(small, usually, spread)
    assert probable(np.where(np.arange(20) == 3, 2.8, small), usually, spread)
    assert not probable(np.where(np.arange(20) == 3, 4.0, 0.2 * small), usually, spread)


def test_an_error_is_judged_by_as_much_of_it_as_recordings_show() -> None:
    """Where 0.77 is usual 3 is much; what hardly shows is not judged so, since it takes on what others leave."""
    errors = np.array([3.0, *np.zeros(19)])
    assert probable(errors, np.eye(20), 0.1 * np.eye(20))
    assert not probable(errors, np.eye(20), 0.4 * np.eye(20))
    assert probable(0.5 * errors, np.eye(20), 0.9 * np.eye(20))
