"""What can be told apart, exactly: the ranks and deficits of the docs/theory.md, sections 2, 4 and 8."""

from dataclasses import replace

import numpy as np
import pytest
from gravity_rig import DOWN, SARCOS_BETA, make_random_arm, make_readings, make_sarcos, sweep_rows

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import base_parameter_names
from gcomp.identify.global_fit import GlobalFit, identify_global, predict_covariance
from gcomp.identify.parameters import FAMILIES, Parameters, family_slices
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict, predict_and_jacobian

SENSORS = ("gain", "offset", "beta")
POSITIONS = ("position_gain", "position_offset")


def fit(
    arm: Arm, unknown: tuple[str, ...], *, poses: int, sensors: str = "own", loads: tuple[float, ...] = (0.0,)
) -> GlobalFit:
    rng = np.random.default_rng(5)
    n = arm.n
    true = Parameters.nominal(
        n,
        gain=rng.uniform(0.8, 1.2, n),
        offset=rng.normal(size=n),
        beta=SARCOS_BETA if n == 7 else rng.normal(size=2 * n),
        rho=[0.05, -0.03, 0.1],
    )
    positions, marks = sweep_rows(arm, poses, 13, rng, sensors=sensors)
    middle = (arm.lower + arm.upper) / 2  # generic poses: stops of round numbers can be special
    positions = middle + 0.97 * (positions - middle) + 0.05 * rng.normal(size=n)
    rows = make_readings(arm, true, positions, marks, loads=loads, sigma=0.01)
    return identify_global(arm, rows, unknown=unknown, start=true)


@pytest.mark.parametrize(
    ("unknown", "poses", "sensors", "loads", "deficit"),
    [
        (SENSORS, 1, "own", (0.0,), 7),
        (SENSORS, 2, "own", (0.0,), 1),
        (SENSORS, 1, "all", (0.0,), 1),
        (("gain", "offset", "position_offset", "beta"), 1, "own", (0.0,), 2 * 7 - 1),
        ((*SENSORS, *POSITIONS), 2, "own", (0.0,), 2 - 1),
        ((*SENSORS, *POSITIONS), 1, "all", (0.0,), 2 - 1),
        ((*SENSORS, "rho"), 1, "own", (0.0, 2.0), 0),
        ((*SENSORS, "rho"), 2, "own", (0.0, 2.0), 0),
        ((*SENSORS, "rho"), 2, "own", (2.0,), 4),
        (FAMILIES, 2, "own", (0.0, 2.0), 1 - 1),
    ],
)
def test_rank_deficit_of_the_calibration(
    unknown: tuple[str, ...], poses: int, sensors: str, loads: tuple[float, ...], deficit: int
) -> None:
    """Section 4's table; minus one where θ0_n is among the unknowns: gcomp holds it (turning link n's frame)."""
    found = fit(make_sarcos(), unknown, poses=poses, sensors=sensors, loads=loads)
    assert len(found.null_space) == deficit


@pytest.mark.parametrize(("gravity_unknown", "deficit"), [(False, 2), (True, 3)])
def test_an_unknown_direction_of_gravity_costs_one_more(gravity_unknown: bool, deficit: int) -> None:
    """Section 4's table with θ0_n free: the analytic Jacobian, and two columns for turning g by differences."""
    arm, rng = make_sarcos(), np.random.default_rng(6)
    true = Parameters.nominal(7, gain=rng.uniform(0.8, 1.2, 7), beta=SARCOS_BETA)
    positions, marks = sweep_rows(arm, 2, 13, rng)
    generic = positions + np.repeat(0.3 * rng.normal(size=(14, 7)), 13, axis=0)  # another pose for each sweep
    rows = StaticReadings.of(generic, marks, 1.0)
    jacobian = predict_and_jacobian(arm, true, rows)[1]
    families = family_slices(7)
    columns = [jacobian[:, families[name]] for name in (*SENSORS, *POSITIONS)]
    if gravity_unknown:
        step = 1e-5
        for across in (np.array([0, 1.0, 0]), np.array([0, 0, 1.0])):
            ahead, behind = (
                predict(replace(arm, gravity=arm.gravity + sign * step * 9.81 * across), true, rows)[rows.counted]
                for sign in (1, -1)
            )
            columns.append(((ahead - behind) / (2 * step))[:, None])
    stacked = np.hstack(columns)
    singular = np.linalg.svd(stacked / np.linalg.norm(stacked, axis=0), compute_uv=False)
    assert np.sum(singular < 1e-9 * singular[0]) == deficit
    assert singular[-deficit - 1] > 1e-6 * singular[0]


def test_common_scale_is_named_and_offsets_stay() -> None:
    found = fit(make_sarcos(), SENSORS, poses=2)
    assert found.null_space == (
        ", ".join(f"gain[joint_{i}]" for i in range(1, 8))
        + (
                " can change by one common factor together with all mass moments: readings with a reference "
                "mass fix this factor"
                ),
    )  # fmt: skip
    assert set(found.not_identifiable) == {name for name in found.names if not name.startswith("offset")}
    assert np.isfinite(found.values.offset).all()
    assert np.isnan(found.values.gain).all()
    assert np.isinf(found.std.gain).all()


def test_vertical_first_axis_leaves_its_gain_zero_and_moment_dead_but_not_its_offset() -> None:
    found = fit(make_sarcos(DOWN), FAMILIES, poses=2, loads=(0.0, 2.0))
    assert set(found.not_identifiable) == {
        "gain[joint_1]",
        "position_gain[joint_1]",
        "position_offset[joint_1]",
        "mass_moment_x[joint_1]",
        "mass_moment_y[joint_1]",
    }
    assert np.isfinite(found.values.offset).all()
    assert all("changes no reading" in sentence for sentence in found.null_space)


def base_count(arm: Arm) -> int:
    """Number of mass moments that poses of every joint determine; the names that need no poses are the same."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-3, 3, (60, arm.n))
    true = Parameters.nominal(arm.n, beta=rng.normal(size=2 * arm.n))
    found = identify_global(arm, make_readings(arm, true, q, np.zeros_like(q)), unknown=("beta",), start=true)
    assert base_parameter_names(arm) == tuple(np.array(found.names)[found.identifiable])
    return int(found.identifiable.sum())


def planar(gravity: tuple[float, float, float], n: int = 3, tail: tuple[float, ...] = ()) -> Arm:
    alpha = np.array([0.0] * (n - len(tail)) + list(tail))
    names = tuple(f"j{i}" for i in range(n))
    return Arm(
        names, alpha, np.full(n, 0.3), np.zeros(n), np.zeros(n), np.array(gravity), np.full(n, -3), np.full(n, 3)
    )


def test_number_of_gravity_base_parameters() -> None:
    """2(n − p), p leading joints whose axis is along gravity in every pose."""
    assert base_count(planar((0, -9.81, 0))) == 6
    assert base_count(planar((0, 0, -9.81))) == 0
    assert base_count(planar((0, 0, -9.81), 5, (np.pi / 2, 0.0, 0.0))) == 2 * (5 - 3)
    assert base_count(make_sarcos()) == 14
    assert base_count(make_sarcos(DOWN)) == 12
    for seed in range(10):
        built = make_random_arm(np.random.default_rng(seed))
        assert base_count(built.arm) == 2 * built.arm.n


def test_planar_arm_cannot_tell_position_offsets_from_moments_but_finds_the_rest() -> None:
    arm, rng = planar((0, -9.81, 0)), np.random.default_rng(0)
    true = Parameters.nominal(3, beta=[2.0, 0.3, 1.0, -0.2, 0.5, 0.1], offset=[0.1, 0.2, 0.3])
    rows = make_readings(arm, true, *sweep_rows(arm, 3, 13, rng))
    found = identify_global(arm, rows, unknown=("offset", "position_offset", "beta"))
    assert not any(good for name, good in zip(found.names, found.identifiable, strict=True) if "position" in name)
    assert found.values.offset == pytest.approx(true.offset, abs=1e-9)


def test_a_hair_of_tilt_counts_as_no_answer_not_as_a_wild_one() -> None:
    """1e-7 rad of tilt, as rounded angles make it, must not yield a gain of joint 1."""
    tilted = 9.81 * np.array([1e-7, 0, -1])
    found = fit(make_sarcos(tuple(tilted)), (*SENSORS, "rho"), poses=2, loads=(0.0, 2.0))
    assert "gain[joint_1]" in found.not_identifiable
    assert "gain[joint_2]" not in found.not_identifiable


def test_a_weakly_tilted_axis_is_listed_as_hopeless_with_its_interval() -> None:
    arm = make_sarcos(tuple(9.81 * np.array([np.sin(1e-3), 0, -np.cos(1e-3)])))
    rng = np.random.default_rng(3)
    true = Parameters.nominal(7, beta=SARCOS_BETA, rho=[0.05, -0.03, 0.1])
    rows = make_readings(arm, true, *sweep_rows(arm, 2, 13, rng), loads=(0.0, 2.0), sigma=0.05, rng=rng)
    found = identify_global(arm, rows, unknown=(*SENSORS, "rho"))
    assert "gain[joint_1]" in (*found.hopeless, *found.not_identifiable)
    assert 0.001 < found.std.gain[1] < 0.02


def test_prediction_before_moving_is_the_covariance_afterwards(sarcos) -> None:
    rng = np.random.default_rng(2)
    true = Parameters.nominal(7, beta=SARCOS_BETA, rho=[0.05, -0.03, 0.1])
    rows = make_readings(sarcos, true, *sweep_rows(sarcos, 2, 13, rng), loads=(0.0, 2.0))
    predicted = predict_covariance(sarcos, rows, true, unknown=FAMILIES)
    found = identify_global(sarcos, rows, unknown=FAMILIES)
    assert predicted.covariance == pytest.approx(found.covariance, rel=1e-6, abs=1e-12)
    assert predicted.std.gain == pytest.approx(found.std.gain, rel=1e-6)
