"""A payload that is weighed with the records of realistic sweeps: errors are those that are stated."""

import numpy as np
import pytest
from drawn_payloads import calibrated_arm


@pytest.mark.parametrize(("seed", "level"), [(4, 0.0), (7, 3.0)])
def test_mass_and_centre_are_within_what_is_stated(seed, level):
    arm = calibrated_arm(seed, level)
    for mass in (0.2, 2.0):
        weighed = arm.weigh(mass, np.array([0.03, -0.05, 0.06]), 12, seed)
        assert np.nanmax(np.abs(weighed.errors)) < 3.0
        assert weighed.found.mass_std < 0.05 * mass + 0.02


def test_an_arm_that_carries_nothing_weighs_nothing_and_has_no_centre():
    found = calibrated_arm(4, 0.0).weigh(0.0, np.zeros(3), 12, 1).found
    assert abs(found.mass) < 3 * found.mass_std
    assert np.isnan(found.centre).all()
