"""Scatter of creep readings: two directions, ripple, rounding of temperatures, and bins at unsteady speed."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_creeps import creep_rows, draw_creep, without
from judged_creeps import creep_arm

from armlink.arrays import Array
from calib.arm.kinematics import gcomp_arm
from calib.fit.creep_fit import CreepFit, fit_rows
from calib.fit.creep_residuals import Scatter, ripple_cycles, scatter
from calib.fit.sweep_readings import SweepReadings, steady
from calib.plan.creep_plan import plan_creep

BINS, SWEEPS = 14, 5
NONE = np.zeros(2 * BINS * SWEEPS)


def creeps(span: float = 1.1) -> SweepReadings:
    """Sweeps of one joint, up and down through the same bins, which differ a little in place."""
    random, rows = np.random.default_rng(0), 2 * BINS * SWEEPS
    places = np.linspace(0.2, 0.2 + span, BINS)
    position = np.tile(np.concatenate([places, places[::-1]]), SWEEPS) + 1e-3 * random.standard_normal(rows)
    return creep_rows(
        joint=np.zeros(rows, dtype=np.int64),
        position=position[:, None],
        reading=np.ones(rows),
        velocity=0.1 * np.tile(np.repeat([1.0, -1.0], BINS), SWEEPS),
        mass=np.zeros(rows),
        warmth=np.zeros(rows),
        sweep=np.repeat(np.arange(SWEEPS), 2 * BINS),
        sweeps=tuple(f"creep {k}" for k in range(SWEEPS)),
        warmest=np.array([np.nan]),
    )


def covariances(found: Scatter) -> list[Array]:
    """Of each sweep."""
    return [np.asarray(np.linalg.inv(whitening.T @ whitening), float) for _, whitening in found.blocks]


def test_half_sums_and_half_differences_scatter_each_in_its_own_way() -> None:
    rows, random = creeps(), np.random.default_rng(1)
    alike, opposite = 5e-3, 1e-3
    residual = np.empty(len(rows))
    for sweep in range(SWEEPS):
        own = np.flatnonzero(rows.readings.series == sweep)
        half_sum, half_difference = random.normal(0, alike, BINS), random.normal(0, opposite, BINS)
        residual[own] = np.concatenate([half_sum + half_difference, (half_sum - half_difference)[::-1]])
    found = scatter(rows, residual, np.array([10.0]), 1.0, NONE)
    covariance = covariances(found)[0]
    of_sum = (covariance[0, 0] + covariance[0, BINS]) / 2
    of_difference = (covariance[0, 0] - covariance[0, BINS]) / 2
    assert np.sqrt(of_sum) == pytest.approx(alike, rel=0.5)
    assert np.sqrt(of_difference) == pytest.approx(opposite, rel=0.5)
    white = found.whitened(np.stack([residual, 2 * residual], axis=1))
    assert np.mean(white[:, 0] ** 2) == pytest.approx(1.0, abs=0.35)
    np.testing.assert_allclose(white[:, 1], 2 * white[:, 0])


def test_what_a_degree_makes_is_alike_in_all_rows_of_a_sweep() -> None:
    rows = creeps()
    residual = np.random.default_rng(2).normal(0, 1e-3, len(rows))
    plain = scatter(rows, residual, np.array([10.0]), 1.0, NONE)
    warm = scatter(rows, residual, np.array([10.0]), 1.0, np.full(len(rows), 3e-3))
    for before, after in zip(covariances(plain), covariances(warm), strict=True):
        np.testing.assert_allclose(after - before, 9e-6, atol=1e-12)


def test_places_that_one_direction_lacks_have_no_partner() -> None:
    rows = creeps()
    kept = rows.kept(~((rows.side < 0) & (rows.readings.position[:, 0] < 0.5)))
    residual = np.random.default_rng(3).normal(0, 1e-3, len(kept))
    found = scatter(kept, residual, np.array([10.0]), 1.0, NONE[: len(kept)])
    assert sorted(np.concatenate([each for each, _ in found.blocks]).tolist()) == list(range(len(kept)))
    assert np.mean(found.whitened(residual) ** 2) == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("cycles", [14.0, 19.3, 27.0])
def test_the_period_of_a_ripple_is_found(cycles: float) -> None:
    rows = creeps()
    place = rows.readings.position[:, 0]
    residual = 2e-3 * np.sin(cycles * place + 1.0) + np.random.default_rng(4).normal(0, 1e-3, len(rows))
    assert ripple_cycles(rows, residual)[0] == pytest.approx(cycles, abs=0.5)


def test_no_ripple_is_found_in_noise_or_in_a_slow_course() -> None:
    rows, random = creeps(), np.random.default_rng(5)
    noise = random.normal(0, 1e-3, (100, len(rows)))
    assert not any(ripple_cycles(rows, each).any() for each in noise)
    opposite = rows.side * 2e-3 * np.sin(19.0 * rows.readings.position[:, 0])
    assert not ripple_cycles(rows, noise[0] + opposite).any()
    assert not ripple_cycles(rows.kept(rows.readings.position[:, 0] < 0.4), noise[0]).any()


def fitted(**changes: float) -> tuple[CreepFit, Array, Array]:
    """(Fit, gains, Coulomb friction) of a drawn arm."""
    arm = without(creep_arm(5), **changes)
    plan = plan_creep(arm)
    made = draw_creep(arm, plan, 3, plan.reference_mass)
    fit = fit_rows(gcomp_arm(arm), made.rows, arm.require_link().rated_torques)
    return fit, made.warm_gain, made.state.coulomb


@pytest.mark.long
def test_ripple_is_fitted_and_does_not_widen_the_intervals() -> None:
    plain, *_ = fitted(cogging=0.0)
    rippled, gain, coulomb = fitted(cogging=0.6)
    assert not plain.ripple.any()
    assert rippled.ripple.all()
    for family in ("gain", "load", "viscous"):
        assert (rippled.std(family) < 1.5 * plain.std(family)).all()
    assert (np.abs(rippled.value("gain") - gain) < 4 * rippled.std("gain")).all()
    sizes = np.linalg.norm(rippled.value("ripple").reshape(-1, 2), axis=1)
    np.testing.assert_allclose(sizes, 0.1 * 0.6 * coulomb, rtol=0.2)


@pytest.mark.long
def test_the_usual_unevenness_of_friction_is_that_of_all_joints() -> None:
    uneven, *_ = fitted()
    even, *_ = fitted(uneven=0.0)
    shares = [
        (fit.prior_std[fit.slices["uneven"]].reshape(-1, 4)[:, :2].T / fit.value("coulomb")).mean()
        for fit in (even, uneven)
    ]
    assert shares[0] < 0.7 * shares[1]
    assert 0.07 < shares[1] < 0.16


def test_bins_at_unsteady_speed_are_left_out() -> None:
    rows = creeps()
    velocity = rows.readings.velocity * (1 + 2e-3 * np.random.default_rng(6).standard_normal((len(rows), 1)))
    velocity[:2, 0] *= [1.1, 1.04]
    left = steady(replace(rows, readings=replace(rows.readings, velocity=velocity)))
    assert np.flatnonzero(~left).tolist() == [0, 1]
    rough = rows.readings.velocity * (1 + 0.03 * np.random.default_rng(7).standard_normal((len(rows), 1)))
    assert steady(replace(rows, readings=replace(rows.readings, velocity=rough))).mean() > 0.95
