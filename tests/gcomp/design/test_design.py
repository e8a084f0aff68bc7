"""Choice of sweeps: against exhaustive and random choice, and what it promises is what a fit then finds."""

import numpy as np
import pytest
from gravity_rig import SARCOS_BETA, make_readings, sweep_rows

from gcomp.arm.arm import Arm
from gcomp.design.selection import sweep_jacobian
from gcomp.design.sweep_design import Design, JointSweep, choose_sweeps, readings_of, stop_combinations
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_levers
from gcomp.identify.global_fit import Prediction, identify_global, predict_covariance
from gcomp.identify.parameters import Parameters
from gcomp.identify.sensor_model import predict_and_jacobian

SIGMA = np.array([0.15, 0.15, 0.08, 0.06, 0.03, 0.03, 0.02])
GUESS = Parameters.nominal(7, beta=SARCOS_BETA, rho=[0.0, 0.0, 0.1])
MOMENTS = ("offset", "beta")
CALIBRATION = ("gain", "offset", "beta", "rho")


def log_volume(prediction: Prediction) -> float:
    return float(np.linalg.slogdet(prediction.covariance)[1])


def random_design(arm: Arm, rng: np.random.Generator, poses: int, steps: int) -> Prediction:
    rows = make_readings(arm, GUESS, *sweep_rows(arm, poses, steps, rng), sigma=SIGMA)
    return predict_covariance(arm, rows, GUESS, unknown=MOMENTS)


@pytest.mark.sample(1)
@pytest.mark.parametrize("criterion", ["D", "A"])
def test_chosen_stops_beat_all_of_a_hundred_random_ones(criterion: str, sarcos, rng) -> None:
    design = choose_sweeps(sarcos, GUESS, sigma=SIGMA, unknown=MOMENTS, poses=2, criterion=criterion)
    random = [random_design(sarcos, rng, 2, 25) for _ in range(100)]
    if criterion == "D":
        assert log_volume(design.prediction) < min(map(log_volume, random))
    else:
        worst = np.sum(design.prediction.std.beta**2)
        assert worst < min(np.sum(each.std.beta**2) for each in random)


def test_greedy_choice_is_the_best_of_all_on_a_small_arm(rng) -> None:
    """Three joints, one sweep each: all 4³ combinations can be compared."""
    arm = Arm(
        ("a", "b", "c"), np.array([1.2, -0.8, 0.3]), np.array([0.2, 0.3, 0.1]), np.zeros(3), np.zeros(3),
        np.array([3.0, 4.0, -8.0]), np.array([-1.0, -0.4, -1.5]), np.array([1.7, 2.0, 0.9]),
    )  # fmt: skip
    guess = Parameters.nominal(3, beta=[2.0, 0.5, 1.0, -0.3, 0.4, 0.2])
    design = choose_sweeps(arm, guess, sigma=0.05, unknown=MOMENTS, poses=1, steps=9)
    choices = [[JointSweep(j, pose, np.linspace(arm.lower[j], arm.upper[j], 9)) for pose in stop_combinations(arm, j)]
               for j in range(3)]  # fmt: skip
    every = [
        log_volume(predict_covariance(arm, readings_of(arm, [x, y, z], 0.05), guess, unknown=MOMENTS))
        for x in choices[0] for y in choices[1] for z in choices[2]
    ]  # fmt: skip
    assert log_volume(design.prediction) == pytest.approx(min(every), abs=1e-6)


def test_the_other_joints_are_at_each_combination_of_their_stops_once(sarcos) -> None:
    poses = stop_combinations(sarcos, 2)
    others = np.arange(7) != 2
    assert poses[:, 2] == pytest.approx(np.full(64, (sarcos.lower[2] + sarcos.upper[2]) / 2))
    assert len({tuple(pose) for pose in poses}) == len(poses) == 64
    assert np.all((poses == sarcos.lower)[:, others] | (poses == sarcos.upper)[:, others])


def test_resting_joints_lean_on_stops_and_the_swept_one_feels_gravity(sarcos) -> None:
    design = choose_sweeps(sarcos, GUESS, sigma=SIGMA, unknown=MOMENTS, poses=2, steps=13, margin=0.05)
    assert [sweep.joint for sweep in design.sweeps] == [joint for joint in range(7) for _ in range(2)]
    for sweep in design.sweeps:
        held = np.arange(7) != sweep.joint
        assert np.all((sweep.pose == sarcos.lower)[held] | (sweep.pose == sarcos.upper)[held])
        assert sweep.angles[0] == pytest.approx(sarcos.lower[sweep.joint] + 0.05)
        assert np.all(gravity_levers(sarcos, sweep.positions())[:, sweep.joint] >= 0.3 * 9.81)


def test_prediction_is_what_the_fit_then_reports_and_what_repeats_scatter(sarcos) -> None:
    rng = np.random.default_rng(0)
    design = choose_sweeps(sarcos, GUESS, sigma=SIGMA, unknown=MOMENTS, poses=2, steps=13)
    positions = np.concatenate([sweep.positions() for sweep in design.sweeps])
    marks = readings_of(sarcos, design.sweeps, SIGMA).torque
    fits = [
        identify_global(sarcos, make_readings(sarcos, GUESS, positions, marks, sigma=SIGMA, rng=rng), unknown=MOMENTS)
        for _ in range(60)
    ]
    assert fits[0].std.beta == pytest.approx(design.prediction.std.beta, rel=1e-6)
    scatter = np.std([each.values.beta for each in fits], axis=0)
    assert scatter / design.prediction.std.beta == pytest.approx(np.ones(14), abs=0.35)
    assert np.mean(scatter / design.prediction.std.beta) == pytest.approx(1.0, abs=0.1)


def test_calibration_design_determines_everything_with_small_intervals(sarcos) -> None:
    """Section 4: with P = 2 and μ = 2 kg the best designs give gains to 0.14–0.39 % at σ = 0.05 and 37 steps."""
    design: Design = choose_sweeps(sarcos, GUESS, sigma=0.05, unknown=CALIBRATION, poses=2, steps=37, loads=(0.0, 2.0))
    assert design.prediction.identifiable.all()
    assert np.all(design.prediction.std.gain < 0.006)
    assert np.all(design.prediction.std.rho < 0.001)


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
    sweeps = [JointSweep(2, pose, np.linspace(-1.0, 1.0, 4)) for pose in rng.uniform(-1, 1, (3, n))]
    ours = sweep_jacobian(arm, guess, 2, np.stack([sweep.positions() for sweep in sweeps]), sigma, free, loads)
    for sweep, jacobian in zip(sweeps, ours, strict=True):
        rows = readings_of(arm, [sweep], sigma, loads)
        _, theirs, _ = predict_and_jacobian(arm, guess, rows)
        np.testing.assert_allclose(jacobian, theirs[:, free] / sigma[2], rtol=1e-10, atol=1e-9)
