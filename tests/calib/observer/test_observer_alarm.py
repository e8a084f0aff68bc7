"""Rest detection and alarm, against the figures of docs/theory.md, section 6."""

from dataclasses import replace

import numpy as np
import pytest
from rest_arm import RestArm

from calib.motion.static_reading import StaticReading
from calib.observer.alarms import Cusum
from calib.observer.config import ObserverConfig
from calib.observer.row_makers import RestDetector
from gcomp.gravity.torque import gravity_torque

CONFIG = ObserverConfig()
SIGMA = 0.05
PERIOD = 0.004


def rows_to_alarm(arm, beta, gain, offset, joint, random, most=4000) -> tuple[int, int]:
    """Rows until the first alarm of a drifted joint, and which joint it names."""
    cusum = Cusum(arm.n, CONFIG)
    torque = gravity_torque(arm, beta, random.uniform(arm.lower, arm.upper, (most, arm.n)))
    residual = SIGMA * random.normal(size=torque.shape)
    residual[:, joint] += gain * torque[:, joint] + offset
    for count, (e, tau) in enumerate(zip(residual, torque, strict=True), start=1):
        alarms = cusum.handle(e, tau, np.full(arm.n, SIGMA**2))
        if alarms:
            return count, alarms[0][0]
    return most, -1


@pytest.mark.sample(2)
@pytest.mark.parametrize(("joint", "median"), list(enumerate([2, 2, 5, 5, 89, 32, 797])))
def test_a_gain_drift_of_1_percent_raises_an_alarm_as_soon_as_the_theory_says(
    sarcos, sarcos_beta, joint, median
) -> None:
    random = np.random.default_rng(joint)
    trials = 60 if median < 100 else 25
    counts = [rows_to_alarm(sarcos, sarcos_beta, 0.01, 0.0, joint, random)[0] for _ in range(trials)]
    assert abs(np.median(counts) - median) <= max(1, 0.3 * median)


@pytest.mark.sample(2)
@pytest.mark.parametrize("joint", range(7))
def test_an_offset_drift_raises_an_alarm_within_3_rows_and_names_the_joint(sarcos, sarcos_beta, joint) -> None:
    random = np.random.default_rng(joint)
    results = [rows_to_alarm(sarcos, sarcos_beta, 0.0, 0.2, joint, random) for _ in range(40)]
    assert abs(np.median([count for count, _ in results]) - 2) <= 1
    assert np.mean([named == joint for _, named in results]) > 0.95


@pytest.mark.parametrize("rows", [20_000, pytest.param(60_000, marks=pytest.mark.long)])
def test_false_alarms_are_rarer_than_one_in_5000_rows(sarcos, sarcos_beta, rows) -> None:
    random = np.random.default_rng(9)
    torque = gravity_torque(sarcos, sarcos_beta, random.uniform(sarcos.lower, sarcos.upper, (rows, 7)))
    noise, cusum, alarms = SIGMA * random.normal(size=torque.shape), Cusum(7, CONFIG), 0
    for e, tau in zip(noise, torque, strict=True):
        if cusum.handle(e, tau, np.full(7, SIGMA**2)):
            alarms += 1
            cusum.reset()
    assert alarms < rows / 5000


def run_detector(positions: np.ndarray, torques: np.ndarray, config: ObserverConfig = CONFIG) -> list[StaticReading]:
    """Rows of one joint's samples at 250 Hz."""
    detector, rows = RestDetector(1, config), []
    for k, (q, tau) in enumerate(zip(positions, torques, strict=True)):
        rows += detector.handle(k * PERIOD, np.array([q]), np.array([tau]))
    return rows


def rest(q: float, seconds: float) -> np.ndarray:
    return np.full(round(seconds / PERIOD), q)


def move(start: float, end: float, seconds: float) -> np.ndarray:
    return np.linspace(start, end, round(seconds / PERIOD))


def test_each_stop_is_one_row_with_its_mean_and_its_direction() -> None:
    random = np.random.default_rng(0)
    q = np.concatenate([rest(0, 1), move(0, 0.5, 1), rest(0.5, 0.6), move(0.5, 0.2, 1), rest(0.2, 30)])
    torque = 10 * q + 0.1 * random.normal(size=q.size)
    rows = run_detector(q, torque)
    np.testing.assert_allclose([row.position[0] for row in rows], [0.0, 0.5, 0.2], atol=1e-9)
    np.testing.assert_allclose([row.torque[0] for row in rows], [0.0, 5.0, 2.0], atol=0.05)
    assert [row.direction[0] for row in rows] == [0.0, 1.0, -1.0]


def test_a_short_stop_and_slow_motion_give_no_row() -> None:
    short = np.concatenate([move(-1, 0, 1), rest(0, 0.3), move(0, 1, 1)])
    assert run_detector(short, np.zeros(short.size)) == []
    creeping = move(0, 0.4, 10)
    assert run_detector(creeping, np.zeros(creeping.size)) == []


def test_missing_readings_break_a_rest_but_a_lost_frame_does_not() -> None:
    q = rest(0.0, 0.45)
    lost = q.copy()
    lost[20] = np.nan
    assert len(run_detector(lost, np.zeros(q.size))) == 1
    lost[60:90] = np.nan
    assert run_detector(lost, np.zeros(q.size)) == []
    assert run_detector(q, np.full(q.size, np.nan)) == []


def test_the_halves_of_an_average_tell_its_noise() -> None:
    random = np.random.default_rng(1)
    q = np.concatenate([np.concatenate([rest(k % 2, 0.5), move(k % 2, 1 - k % 2, 1)]) for k in range(60)])
    rows = run_detector(q, 0.5 * random.normal(size=q.size))
    means = np.array([row.torque[0] for row in rows])
    noise = np.array([row.torque_error[0] for row in rows])
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(np.std(means), rel=0.25)


def test_a_row_in_which_a_motion_began_is_none_and_an_arm_that_is_noisier_is_watched_again() -> None:
    arm = RestArm("sarcos", 3)
    observer = arm.observer()
    assert arm.work(observer, 30) == []
    rows, sigma, rest = observer.rows, observer._belief.sigma.copy(), arm.row()
    began = np.where(np.arange(7) == 0, 0.05 * arm.rated, 0.0)
    for _ in range(3):
        assert observer.handle_row(replace(rest, torque=rest.torque + began, torque_error=began / 2)) == []
    assert observer.rows == rows
    assert (observer._belief.sigma < 1.5 * sigma).all()
    noisier = 20 * sigma
    for _ in range(60):
        rest = arm.row()
        observer.handle_row(replace(rest, torque_error=np.abs(noisier * arm.random.normal(size=7))))
    assert observer.rows > rows + 10
    np.testing.assert_array_less(5 * sigma, observer._belief.sigma)
