"""What a fit leaves of the recording that it has not seen."""

import numpy as np
from servo_arm import fitted

from sim_gap.position_gap.training import bands
from sim_gap.position_gap.training.jackknife import gaps_left_out, leave_out


def test_each_recording_is_left_out() -> None:
    search, fit = fitted(0.15, 0.35)
    others = leave_out(search, fit)
    assert (others.groups == search.data.recording).all()
    assert len(others.fits) == 2
    gaps = gaps_left_out(search, others)
    assert gaps.shape == search.data.measured.shape
    friction = np.array([alone.point["coulomb"] for alone in others.fits])
    assert (friction[0] > 0.3).all()
    assert (friction[1] < 0.2).all()


def test_of_a_single_recording_thirds_are_left_out() -> None:
    search, fit = fitted(0.2)
    others = leave_out(search, fit)
    assert len(others.fits) == len(set(others.groups.tolist())) == 3
    assert gaps_left_out(search, others).shape == search.data.measured.shape


def test_noise_does_not_last_from_sample_to_sample_and_an_error_of_the_model_does():
    random, t = np.random.default_rng(7), np.arange(400.0) * 0.02
    lasts = np.stack([np.sin(3.0 * t), np.sin(5.0 * t)], axis=1)
    noise = random.normal(size=(2, 400, 2))
    left = np.stack([noise[0], lasts, noise[1] + lasts * np.sqrt(2.0)], axis=1)
    weight = np.ones_like(left)
    left[::40], weight[::40] = 1e3, 0.0
    np.testing.assert_allclose(bands._lasting(left, weight), [0.0, 1.0, 0.25], atol=0.05)
