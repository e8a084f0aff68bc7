"""The recursion: exact without noise, equal to the global fit where theory says so, honest covariance."""

import numpy as np
import pytest
from gravity_rig import DOWN, SARCOS_BETA, make_random_arm, make_readings, make_sarcos, sweep_rows

from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from gcomp.identify.recursive import identify_recursive


@pytest.mark.parametrize("seed", range(50))
def test_random_arms_are_found_exactly_without_noise(seed: int) -> None:
    """Recursion, global fit and the truth agree: docs/theory.md, section 8, item 1."""
    rng = np.random.default_rng(seed)
    built = make_random_arm(rng)
    arm = built.arm
    offset = rng.normal(size=arm.n)
    true = Parameters.nominal(arm.n, beta=built.beta, offset=offset)
    rows = make_readings(arm, true, *sweep_rows(arm, 2, 9, rng))
    recursive = identify_recursive(arm, rows)
    together = identify_global(arm, rows, unknown=("offset", "beta"))
    assert recursive.identifiable.all()
    assert recursive.beta == pytest.approx(built.beta, abs=1e-9)
    assert recursive.offset == pytest.approx(offset, abs=1e-9)
    assert together.values.beta == pytest.approx(built.beta, abs=1e-9)
    q = rng.uniform(-3, 3, (50, arm.n))
    for beta in (recursive.beta, together.values.beta):
        assert np.abs(gravity_torque(arm, beta, q) - gravity_torque(arm, built.beta, q)).max() < 1e-9


def test_with_one_sweep_a_joint_it_equals_the_global_fit_noise_and_all(sarcos, rng) -> None:
    true = Parameters.nominal(7, beta=SARCOS_BETA, offset=rng.normal(size=7))
    rows = make_readings(sarcos, true, *sweep_rows(sarcos, 1, 25, rng), rng=rng)
    recursive, together = identify_recursive(sarcos, rows), identify_global(sarcos, rows, unknown=("offset", "beta"))
    assert np.abs(recursive.beta - together.values.beta).max() < 1e-9
    assert np.abs(recursive.offset - together.values.offset).max() < 1e-9
    same = np.r_[7:21, 0:7]  # the recursion lists moments first
    assert recursive.covariance == pytest.approx(together.covariance[np.ix_(same, same)], rel=1e-6, abs=1e-12)


def test_covariance_is_the_scatter_of_repeated_identifications(sarcos, rng) -> None:
    true = Parameters.nominal(7, beta=SARCOS_BETA)
    positions, marks = sweep_rows(sarcos, 1, 13, rng)
    found = [identify_recursive(sarcos, make_readings(sarcos, true, positions, marks, rng=rng)) for _ in range(200)]
    scatter = np.std([each.beta for each in found], axis=0)
    assert scatter == pytest.approx(np.sqrt(np.diag(found[0].covariance)[:14]), rel=0.2)


def test_vertical_first_joint_loses_its_moment_and_nothing_else(rng) -> None:
    arm = make_sarcos(DOWN)
    true = Parameters.nominal(7, beta=SARCOS_BETA, offset=np.full(7, 0.3))
    fit = identify_recursive(arm, make_readings(arm, true, *sweep_rows(arm, 2, 13, rng)))
    assert np.isnan(fit.beta[:2]).all()
    assert np.isnan(fit.covariance[0]).all()
    assert fit.beta[2:] == pytest.approx(SARCOS_BETA[2:], abs=1e-9)
    assert fit.offset == pytest.approx(np.full(7, 0.3), abs=1e-9)


def test_two_angles_do_not_determine_a_moment(sarcos, rng) -> None:
    true = Parameters.nominal(7, beta=SARCOS_BETA)
    rows = make_readings(sarcos, true, *sweep_rows(sarcos, 1, 2, rng))
    with pytest.raises(BadArray, match="joint joint_7: 2 steps do not determine its moment"):
        identify_recursive(sarcos, rows)


def test_a_joint_without_a_sweep_and_loaded_rows_are_refused(sarcos) -> None:
    torque = np.zeros((5, 7))
    torque[:, 3] = np.nan
    with pytest.raises(BadArray, match="joint joint_4: this joint has no usable torque reading"):
        identify_recursive(sarcos, StaticReadings.of(np.random.default_rng(0).normal(size=(5, 7)), torque, 0.05))
    with pytest.raises(BadArray, match="unloaded readings only"):
        identify_recursive(sarcos, StaticReadings.of(np.zeros((5, 7)), torque, 0.05, 2.0))
