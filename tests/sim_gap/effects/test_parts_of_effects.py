"""Single figures of effects: inertia of a point mass, what can exist, lag of a drive."""

from dataclasses import replace

import numpy as np
import pytest

from gcomp.arm.inertials import point_mass, pseudo_inertia
from sim_gap.effects.drive import _lag
from sim_gap.effects.effect import Ratings
from sim_gap.effects.registry import effects


@pytest.mark.parametrize("mass", [2.0, -0.5])
def test_a_point_mass_has_its_inertia_by_the_parallel_axes(mass: float) -> None:
    inertial = point_mass(mass, mass * np.array([0.1, 0.0, 0.2]))
    xx, xy, xz, yy, yz, zz = inertial[4:] / mass
    assert (xx, yy, zz) == pytest.approx((0.04, 0.05, 0.01))
    assert (xy, xz, yz) == pytest.approx((0.0, -0.02, 0.0))
    assert np.linalg.matrix_rank(pseudo_inertia(inertial), tol=1e-9) == 1


RATINGS = Ratings(
    friction=0.4, damping=0.2, armature=0.1, speed=0.5, torque=30.0, tip_mass=1.5, mass=12.0, dry=1.0, own=None
)


def bounds(effect: str, ratings: Ratings = RATINGS) -> tuple[np.ndarray, np.ndarray]:
    low, high = effects()[effect].plausibility.limits(ratings, ())
    return np.atleast_1d(low), np.atleast_1d(high)


def test_no_more_can_be_missing_than_the_last_link_has_and_no_body_hangs_far_off() -> None:
    low, high = bounds("link.payload")
    assert -1.5 < low[0] < -1.4
    assert high[0] == 12.0
    _, near = bounds("link.payload", replace(RATINGS, own=np.array([5.0, 0.0, 0.0, 4.0])))
    assert 1.0 < near[3] < 4.0


def test_friction_and_rotor_may_be_less_than_the_model_has_but_not_less_than_none() -> None:
    assert bounds("friction.coulomb")[0] == pytest.approx(-0.5)  # both kinds at the usual speed
    assert bounds("friction.viscous")[0] == pytest.approx(-1.0)
    assert bounds("actuator.rotor_inertia")[0] == pytest.approx(-0.1)


@pytest.mark.parametrize("effect", ["friction.coulomb", "friction.stribeck"])
def test_no_joint_rubs_by_more_than_its_drive_was_seen_to_make(effect: str) -> None:
    assert bounds(effect)[1] == 30.0


@pytest.mark.parametrize("effect", ["friction.stribeck", "friction.load", "transmission.elasticity"])
def test_what_adds_to_friction_or_gives_way_is_not_negative(effect: str) -> None:
    assert bounds(effect)[0] == 0.0


@pytest.mark.parametrize("time", [0.005, 0.05])
def test_a_drive_with_a_lag_is_behind_a_ramp_by_exactly_that_time(time: float) -> None:
    ramp = 3.0 * np.arange(2000) / 100.0
    assert _lag(ramp, time, 100.0)[-1] == pytest.approx(3.0 * time, rel=1e-6)
