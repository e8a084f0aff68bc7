from dataclasses import replace

import numpy as np
import pytest
from servo_arm import model_text, record, search_on

from sim_gap.position_gap.fit import LoopFit, rms_on
from sim_gap.position_gap.identify import _margin
from sim_gap.position_gap.sound_arm import probable, sound_gap
from sim_gap.position_gap.start import noise_floor

NOMINAL = model_text(kp=40.0, friction=0.05)


def split(real: str):
    """What small errors make of the nominal model's gap against an arm, whether it is sound, margin and RMS [rad]."""
    search, other = (search_on(NOMINAL, [record(real, seed, 26.0)]) for seed in (1, 2))
    search = replace(search, floor=noise_floor(search.data))
    fit = LoopFit(search.nominal)
    margin = _margin(search, fit)
    return *sound_gap(search, other.data, margin), margin, rms_on(search.data, fit.point)


def test_errors_of_a_hundredth_are_those_of_a_sound_arm() -> None:
    usual, sound, margin, gap = split(model_text(kp=40.4, friction=0.06, damping=0.808))
    assert sound
    assert (gap < 3.0 * np.maximum(usual, margin)).all()


@pytest.mark.long
def test_a_tilt_is_no_error_of_a_sound_arm() -> None:
    """It acts where other poses feel gravity least, as no gain or mass does."""
    _, sound, _, _ = split(NOMINAL.replace("<option", '<option gravity="2.43 0 -9.5"'))
    assert not sound


@pytest.mark.long
def test_a_gain_that_is_far_off_is_no_error_of_a_sound_arm() -> None:
    _, sound, _, _ = split(model_text(kp=36.0, friction=0.05))
    assert not sound


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
