"""Gravity torque, regressor and stiffness against Pinocchio, against published figures and against each other."""

import numpy as np
import pinocchio as pin
import pytest
from gravity_rig import DOWN, SARCOS_BETA, SARCOS_MASS, make_random_arm, make_sarcos, pinocchio_torque, to_pinocchio

from gcomp.arm.mass_moments import base_parameters, payload_columns
from gcomp.errors import BadArray
from gcomp.gravity.batch import GravityModel
from gcomp.gravity.torque import gravity_levers, gravity_regressor, gravity_stiffness, gravity_torque, torque_covariance

FIRST_TO_SEVENTH = np.arange(1, 8) / 10


@pytest.mark.parametrize("seed", range(50))
def test_random_arms_hold_what_pinocchio_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    built = make_random_arm(rng)
    q = rng.uniform(-4, 4, (20, built.arm.n))
    expected = pinocchio_torque(built, q)
    model = GravityModel(built.arm, built.beta)
    assert np.abs(gravity_torque(built.arm, built.beta, q) - expected).max() < 1e-9
    assert np.abs(gravity_regressor(built.arm, q) @ built.beta - expected).max() < 1e-9
    assert np.abs(np.array([model.one(row) for row in q]) - expected).max() < 1e-9


@pytest.mark.parametrize("seed", range(50))
def test_regressor_is_what_pinocchios_mass_moment_columns_give(seed: int) -> None:
    rng = np.random.default_rng(seed)
    built = make_random_arm(rng)
    arm, model = built.arm, to_pinocchio(built)
    data, none = model.createData(), np.zeros(built.arm.n)
    q = rng.uniform(-3, 3, (5, arm.n))
    regressor = gravity_regressor(arm, q)
    for row, y in zip(q, regressor, strict=True):
        columns = pin.computeJointTorqueRegressor(model, data, row + arm.theta_offset, none, none)
        in_plane = np.concatenate([[10 * i + 1, 10 * i + 2] for i in range(arm.n)])  # of (m, mx, my, mz, I…) per link
        assert np.abs(columns[:, in_plane] - y).max() < 1e-9
        for link in range(arm.n):  # mass and moment along the axis act through the lower joints' columns
            unit_mass, unit_moment = np.eye(arm.n)[link], np.zeros((arm.n, 3))
            by_mass = base_parameters(arm, unit_mass, unit_moment)
            unit_moment[link, 2] = 1.0
            by_axis = base_parameters(arm, np.zeros(arm.n), unit_moment)
            assert np.abs(columns[:, 10 * link] - y @ by_mass).max() < 1e-9
            assert np.abs(columns[:, 10 * link + 3] - y @ by_axis).max() < 1e-9


@pytest.mark.parametrize(
    ("q", "expected"),
    [
        (np.zeros(7), [0.948627, -24.497532, -10.360341, 21.488805, 0.271737, 6.558966, -0.582714]),
        (FIRST_TO_SEVENTH, [2.676536, -28.269372, -11.234690, 15.622890, 0.355674, 3.202491, 0.361110]),
        (
            np.array([-0.5, 0.9, 1.2, 1.7, -1.1, 0.4, -0.3]),
            [-8.104201, -25.042790, -10.639538, -13.690589, -0.393745, -5.041955, 0.859471],
        ),
    ],
)
def test_sarcos_holds_the_published_torques(q: np.ndarray, expected: list[float]) -> None:
    assert gravity_torque(make_sarcos(), SARCOS_BETA, q) == pytest.approx(np.array(expected), abs=1e-6)


def test_upright_sarcos_feels_nothing_at_its_vertical_joint() -> None:
    torque = gravity_torque(make_sarcos(DOWN), SARCOS_BETA, FIRST_TO_SEVENTH)
    assert torque == pytest.approx(
        np.array([0, 1.132892, -2.404994, 13.547637, 0.042582, 5.468321, 0.504834]), abs=1e-6
    )


def test_sinusoid_of_each_joint_has_the_published_amplitude_and_phase(sarcos) -> None:
    """A_i and Φ_i in τ_i = A_i sin(θ_i + Φ_i), from the torque at θ_i and a quarter turn on."""
    ahead = FIRST_TO_SEVENTH + np.eye(7) * np.pi / 2
    now = gravity_torque(sarcos, SARCOS_BETA, FIRST_TO_SEVENTH)
    later = np.diag(gravity_torque(sarcos, SARCOS_BETA, ahead))
    amplitude = [2.694066, 28.291837, 13.121305, 20.646226, 2.277339, 6.476496, 0.514742]
    phase = [1.584938, -1.810650, -2.413690, 1.883350, 2.484771, 2.024357, 0.077552]
    assert np.hypot(now, later) == pytest.approx(np.array(amplitude), abs=1e-6)
    turned = np.arctan2(now, later) - FIRST_TO_SEVENTH - phase
    assert np.angle(np.exp(1j * turned)) == pytest.approx(np.zeros(7), abs=2e-6)


def test_table_1_gives_table_2(sarcos, sarcos_moments) -> None:
    assert base_parameters(sarcos, SARCOS_MASS, sarcos_moments) == pytest.approx(SARCOS_BETA, abs=5e-5)


@pytest.mark.parametrize("seed", range(5))
def test_stiffness_is_the_slope_of_the_torque(seed: int) -> None:
    rng = np.random.default_rng(seed)
    built = make_random_arm(rng)
    q, step = rng.uniform(-3, 3, (4, built.arm.n)), 1e-6
    stiffness = gravity_stiffness(built.arm, built.beta, q)
    for joint in range(built.arm.n):
        nudge = step * np.eye(built.arm.n)[joint]
        slope = gravity_torque(built.arm, built.beta, q + nudge) - gravity_torque(built.arm, built.beta, q - nudge)
        assert stiffness[:, :, joint] == pytest.approx(slope / (2 * step), abs=1e-6)
    assert np.array_equal(stiffness, np.swapaxes(stiffness, 1, 2))


def test_payload_columns_are_those_of_the_arm_built_with_the_mass(random_arm, rng) -> None:
    for _ in range(20):
        built, load, point = random_arm(rng), float(rng.uniform(0.1, 3)), rng.uniform(-0.3, 0.3, 3)
        mass, moment = built.mass.copy(), built.first_moment.copy()
        mass[-1] += load
        moment[-1] += load * point
        fixed, by_point = payload_columns(built.arm)
        expected = base_parameters(built.arm, mass, moment)
        assert built.beta + load * (fixed + by_point @ point) == pytest.approx(expected, abs=1e-12)


def test_sarcos_payload_acts_through_the_published_levers(sarcos) -> None:
    fixed, by_point = payload_columns(sarcos)
    load = np.zeros(14)
    load[[3, 7]] = -0.40, 0.25
    assert fixed == pytest.approx(load, abs=1e-12)
    assert by_point[11] == pytest.approx([0, 0, -1], abs=1e-12)
    assert by_point[12:, :2] == pytest.approx(np.eye(2), abs=1e-12)


def test_many_poses_are_the_poses_one_by_one_across_block_borders(sarcos, rng) -> None:
    q = rng.uniform(-3, 3, (5000, 7))
    torque, regressor = gravity_torque(sarcos, SARCOS_BETA, q), gravity_regressor(sarcos, q)
    for row in (0, 1023, 1024, 2047, 2048, 4999):
        assert gravity_torque(sarcos, SARCOS_BETA, q[row]) == pytest.approx(torque[row], abs=1e-12)
        assert gravity_regressor(sarcos, q[row]) == pytest.approx(regressor[row], abs=1e-12)
    assert gravity_torque(sarcos, SARCOS_BETA, q.reshape(10, 500, 7)) == pytest.approx(torque.reshape(10, 500, 7))
    assert gravity_torque(sarcos, SARCOS_BETA, q[:0]).shape == (0, 7)
    assert gravity_regressor(sarcos, q[:0]).shape == (0, 7, 14)


def test_half_turns_and_many_turns_are_exact(sarcos) -> None:
    """tan(θ/2) has its pole at half a turn."""
    for angle in (np.pi, -np.pi, 3 * np.pi, np.nextafter(np.pi, 4), 40 * np.pi + 0.3):
        q = np.full(7, angle)
        expected = GravityModel(sarcos, SARCOS_BETA).one(q)
        assert gravity_torque(sarcos, SARCOS_BETA, q) == pytest.approx(expected, abs=1e-9)


def test_gravity_lever_is_what_is_left_of_gravity_across_the_axis() -> None:
    """docs/theory.md, section 2: with joint 1 of the tilted sarcos at 90°, joint 2's axis points along gravity."""
    q = np.zeros(7)
    q[0] = np.pi / 2
    assert gravity_levers(make_sarcos(), q)[1] == pytest.approx(0, abs=1e-12)
    assert gravity_levers(make_sarcos(), np.zeros(7))[0] == pytest.approx(9.81)


def test_torque_covariance_is_the_scatter_of_the_torque(sarcos, rng) -> None:
    factor = 0.01 * rng.normal(size=(14, 14))
    q = rng.uniform(-2, 2, (2, 7))
    covariance = torque_covariance(sarcos, factor @ factor.T, q)
    beta = SARCOS_BETA + rng.normal(size=(4000, 14)) @ factor.T
    scatter = np.array([gravity_regressor(sarcos, row) @ beta.T for row in q])
    for predicted, samples in zip(covariance, scatter, strict=True):
        assert np.std(samples, axis=1) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.05)


def test_wrong_shapes_are_named(sarcos) -> None:
    with pytest.raises(BadArray, match=r"beta has shape \(13,\), expected \(14\)"):
        gravity_torque(sarcos, SARCOS_BETA[:13], np.zeros(7))
    with pytest.raises(BadArray, match=r"q has shape \(3, 6\), expected \(…, 7\)"):
        gravity_regressor(sarcos, np.zeros((3, 6)))
