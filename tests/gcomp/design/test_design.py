"""Choice of candidates: against exhaustive and random choice; stops; and what is predicted is what a fit then finds."""

import itertools

import numpy as np
import pytest
from gravity_rig import SARCOS_BETA, make_readings, sweep_rows

from gcomp.arm.arm import Arm
from gcomp.design.selection import select, stop_combinations, sufficient_levers, sweep_jacobian
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.global_fit import identify_global, predict_covariance
from gcomp.identify.parameters import Parameters, free_mask
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict_and_jacobian

SIGMA = np.array([0.15, 0.15, 0.08, 0.06, 0.03, 0.03, 0.02])
GUESS = Parameters.nominal(7, beta=SARCOS_BETA, rho=[0.0, 0.0, 0.1])
MOMENTS = ("offset", "beta")
CALIBRATION = ("gain", "offset", "beta", "rho")


def swept(arm: Arm, joint: int, stops: np.ndarray, steps: int = 9) -> np.ndarray:
    """Poses (C, S, n) of a joint that goes from stop to stop in each combination."""
    poses = np.repeat(stops[:, None], steps, axis=1)
    poses[..., joint] = np.linspace(arm.lower[joint], arm.upper[joint], steps)
    return poses


def candidate_rows(arm: Arm, guess: Parameters, sigma: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Weighted Jacobians (1, C, S, p) of each joint's sweeps, and a weak prior."""
    free = free_mask(arm.n, MOMENTS)
    rows = [
        sweep_jacobian(arm, guess, j, swept(arm, j, stop_combinations(arm, j)), sigma, free, (0.0,))[None]
        for j in range(arm.n)
    ]
    return rows, 1e-2 * np.eye(int(free.sum()))[None]


def log_information(rows: list[np.ndarray], prior: np.ndarray, picks: list[list[int]]) -> float:
    chosen = [each[0, pick] for each, of_group in zip(rows, picks, strict=True) for pick in of_group]
    return float(np.linalg.slogdet(prior[0] + sum(each.T @ each for each in chosen))[1])


def test_chosen_stops_beat_all_of_a_hundred_random_ones(sarcos, rng) -> None:
    rows, prior = candidate_rows(sarcos, GUESS, SIGMA)
    chosen = log_information(rows, prior, select(rows, prior, [2] * 7))
    random = [[rng.permutation(64)[:2].tolist() for _ in rows] for _ in range(100)]
    assert chosen > max(log_information(rows, prior, picks) for picks in random)


def test_greedy_choice_is_the_best_of_all_on_a_small_arm(rng) -> None:
    """Three joints, one sweep each: all 4³ combinations can be compared."""
    arm = Arm(
        ("a", "b", "c"), np.array([1.2, -0.8, 0.3]), np.array([0.2, 0.3, 0.1]), np.zeros(3), np.zeros(3),
        np.array([3.0, 4.0, -8.0]), np.array([-1.0, -0.4, -1.5]), np.array([1.7, 2.0, 0.9]),
    )  # fmt: skip
    guess = Parameters.nominal(3, beta=[2.0, 0.5, 1.0, -0.3, 0.4, 0.2])
    rows, prior = candidate_rows(arm, guess, np.full(3, 0.05))
    every = [log_information(rows, prior, [[i], [j], [k]]) for i, j, k in itertools.product(range(4), repeat=3)]
    assert log_information(rows, prior, select(rows, prior, [1] * 3)) == pytest.approx(max(every), abs=1e-6)


def test_the_other_joints_are_at_each_combination_of_their_stops_once(sarcos) -> None:
    poses = stop_combinations(sarcos, 2)
    others = np.arange(7) != 2
    assert poses[:, 2] == pytest.approx(np.full(64, (sarcos.lower[2] + sarcos.upper[2]) / 2))
    assert len({tuple(pose) for pose in poses}) == len(poses) == 64
    assert np.all((poses == sarcos.lower)[:, others] | (poses == sarcos.upper)[:, others])


def test_levers_are_sufficient_from_a_third_of_gravity_on_or_the_better_half(sarcos) -> None:
    lever = gravity_levers(sarcos, stop_combinations(sarcos, 2))[:, 2] / 9.81
    assert np.all((lever >= 0.3) == sufficient_levers(lever))
    assert sufficient_levers(np.array([0.1, 0.2, 0.25])).tolist() == [False, True, True]


def test_prediction_is_what_the_fit_then_reports_and_what_repeats_scatter(sarcos) -> None:
    rng = np.random.default_rng(0)
    positions, marks = sweep_rows(sarcos, 2, 13, rng)
    design = make_readings(sarcos, GUESS, positions, marks, sigma=SIGMA)
    prediction = predict_covariance(sarcos, design, GUESS, unknown=MOMENTS)
    fits = [
        identify_global(sarcos, make_readings(sarcos, GUESS, positions, marks, sigma=SIGMA, rng=rng), unknown=MOMENTS)
        for _ in range(60)
    ]
    assert fits[0].std.beta == pytest.approx(prediction.std.beta, rel=1e-6)
    scatter = np.std([each.values.beta for each in fits], axis=0)
    assert scatter / prediction.std.beta == pytest.approx(np.ones(14), abs=0.35)
    assert np.mean(scatter / prediction.std.beta) == pytest.approx(1.0, abs=0.1)


def test_sweeps_with_and_without_a_mass_determine_everything_with_small_intervals(sarcos, rng) -> None:
    """Section 4: with P = 2 and μ = 2 kg the best designs give gains to 0.14–0.39 % at σ = 0.05 and 37 steps."""
    design = make_readings(sarcos, GUESS, *sweep_rows(sarcos, 4, 37, rng), loads=(0.0, 2.0), sigma=0.05)
    prediction = predict_covariance(sarcos, design, GUESS, unknown=CALIBRATION)
    assert prediction.identifiable.all()
    assert np.all(prediction.std.gain < 0.006)
    assert np.all(prediction.std.rho < 0.001)


def test_a_joint_without_limits_has_no_stops() -> None:
    arm = Arm(("a",), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1), np.array([0, -9.81, 0.0]),
              np.array([-np.inf]), np.array([np.inf]))  # fmt: skip
    with pytest.raises(BadArray, match="joint a has no limits"):
        stop_combinations(arm, 0)


def test_the_jacobian_of_candidate_sweeps_is_the_sensor_model_s(rng, random_arm) -> None:
    built = random_arm(rng, 5)
    arm, n = built.arm, 5
    guess = Parameters(*(rng.uniform(0.5, 1.5, size) for size in (n, n, n, n, 2 * n, 3)))
    free, sigma, loads = rng.random(6 * n + 3) < 0.7, rng.uniform(0.1, 0.3, n), (0.0, 1.5)
    poses = swept(arm, 2, rng.uniform(-1, 1, (3, n)), 4)
    ours = sweep_jacobian(arm, guess, 2, poses, sigma, free, loads)
    for sweep, jacobian in zip(poses, ours, strict=True):
        torque = np.full((8, n), np.nan)
        torque[:, 2] = 0.0
        rows = StaticReadings.of(np.tile(sweep, (2, 1)), torque, sigma, np.repeat(loads, 4))
        _, theirs, _ = predict_and_jacobian(arm, guess, rows)
        np.testing.assert_allclose(jacobian, theirs[:, free] / sigma[2], rtol=1e-10, atol=1e-9)
