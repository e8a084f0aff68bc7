"""Single figures of effects: inertia of a point mass, which bodies can be, lag of a drive."""

import numpy as np
import pytest

from sim_gap.effects.drive import _lag
from sim_gap.effects.effect import added_or_taken_off
from sim_gap.effects.link import point_mass, pseudo_inertia
from sim_gap.effects.registry import effects


@pytest.mark.parametrize("mass", [2.0, -0.5])
def test_a_point_mass_has_its_inertia_by_the_parallel_axes(mass: float) -> None:
    inertial = point_mass(mass, mass * np.array([0.1, 0.0, 0.2]))
    xx, xy, xz, yy, yz, zz = inertial[4:] / mass
    assert (xx, yy, zz) == pytest.approx((0.04, 0.05, 0.01))
    assert (xy, xz, yz) == pytest.approx((0.0, -0.02, 0.0))
    assert np.linalg.matrix_rank(pseudo_inertia(inertial), tol=1e-9) == 1


def test_no_more_can_be_missing_than_the_last_link_has() -> None:
    can = effects()["link.payload"].plausibility.allows
    tip = {"tip": np.array([1.5])}
    assert can(np.array([-1.4, 0.0, 0.0, 0.0]), (), tip)
    assert not can(np.array([-1.5, 0.0, 0.0, 0.0]), (), tip)
    assert can(np.array([5.0, 0.0, 0.0, 1.0]), (), tip)
    assert not can(np.array([5.0, 0.0, 0.0, 4.0]), (), tip)


def test_little_is_taken_off_only_where_another_effect_builds_on_it() -> None:
    can = lambda coefficient, needed: added_or_taken_off(coefficient, 2.0, {"needed": np.array([needed])})  # noqa: E731
    assert not can(-0.06, 0.0)
    assert can(-0.06, 1.0)
    assert can(-0.12, 0.0)
    assert not can(-2.1, 1.0)
    assert can(0.01, 0.0)


@pytest.mark.parametrize("time", [0.005, 0.05])
def test_a_drive_with_a_lag_is_behind_a_ramp_by_exactly_that_time(time: float) -> None:
    ramp = 3.0 * np.arange(2000) / 100.0
    assert _lag(ramp, time, 100.0)[-1] == pytest.approx(3.0 * time, rel=1e-6)
