"""What a fit leaves of the recording that it has not seen."""

import numpy as np
from servo_arm import fitted

from sim_gap.closed_loop.training.left_out import gaps_left_out, left_out


def test_each_recording_is_left_out() -> None:
    search, fit = fitted(0.15, 0.35)
    others = left_out(search, fit)
    assert (others.groups == search.data.recording).all()
    assert len(others.fits) == 2
    gaps = gaps_left_out(search, others)
    assert gaps.shape == search.data.measured.shape
    friction = np.array([alone.point["coulomb"] for alone in others.fits])
    assert (friction[0] > 0.3).all()
    assert (friction[1] < 0.2).all()


def test_of_a_single_recording_thirds_are_left_out() -> None:
    search, fit = fitted(0.2)
    others = left_out(search, fit)
    assert len(others.fits) == len(set(others.groups.tolist())) == 3
    assert gaps_left_out(search, others).shape == search.data.measured.shape
