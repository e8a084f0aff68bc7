"""Parts of the demo that need no simulated arm: its motion, the joint that drifts, its summary."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.demo.account import Account
from sim_gap.demo.bench import ACCELERATION, RANGE_SHARE, SPEED_SHARE, drifting_joint, multisine
from sim_gap.demo.run import BY, Demo


def motion(low: float, high: float, speeds: tuple[float, float], seed: int) -> tuple[np.ndarray, ...]:
    """Position, velocity and acceleration of two joints over a minute, once it is at its full size."""
    link = SimpleNamespace(rate=200.0, period=0.005)
    limits = [SimpleNamespace(max_velocity=speed) for speed in speeds]
    arm = SimpleNamespace(require_link=lambda: SimpleNamespace(joints=limits))
    described = SimpleNamespace(n=2, lower=np.array([-1.0, low]), upper=np.array([1.0, high]))
    q = multisine(SimpleNamespace(arm=arm, described=described, link=link), 60.0, seed)[1000:]
    v = np.diff(q, axis=0) * link.rate
    return q, v, np.diff(v, axis=0) * link.rate


def test_its_motion_keeps_range_speed_and_acceleration() -> None:
    q, v, a = motion(-3.0, 2.0, (0.2, 8.0), 1)
    assert (np.abs(q - [0.0, -0.5]) <= RANGE_SHARE * np.array([1.0, 2.5]) + 1e-9).all()
    assert (np.abs(v) <= SPEED_SHARE * np.array([0.2, 8.0]) + 1e-6).all()
    assert np.abs(a).max() <= ACCELERATION + 1e-6
    assert (np.ptp(q, axis=0) > 0.05).all()


def test_its_motion_uses_the_acceleration_that_it_may() -> None:
    """On a joint with range and speed in plenty; where the sines meet, in the course of a minute."""
    _, _, a = motion(-90.0, 90.0, (1.0, 50.0), 3)
    assert 0.95 * ACCELERATION < np.abs(a[:, 1]).max() <= ACCELERATION + 1e-6


@pytest.mark.parametrize(
    ("swings", "gains", "joint"),
    [
        ((10.0, 5.0, 4.0), (1.0, 1.0, 1.0), 2),
        ((10.0, 5.0, 1.0), (1.0, 1.0, 1.0), 0),
        ((10.0, 5.0, 1.0), (np.nan, 1.0, 1.0), 1),
    ],
)
def test_the_joint_that_drifts_is_the_third_or_the_one_that_gravity_moves_most(swings, gains, joint) -> None:
    """Of those that have a gain, in shares of their rated torque."""
    calibration = SimpleNamespace(values=lambda name: np.array(gains))
    model = np.array([[-1.0], [1.0]]) * np.array(swings)
    assert drifting_joint(calibration, SimpleNamespace(model=model), np.ones(3)) == joint


def test_a_summary_sets_what_was_found_beside_the_truth(monkeypatch) -> None:
    truth = SimpleNamespace(gain=[1.1], offset=[0.2], position_gain=[1.01], attachment=[0.0, 0.0, 0.1])
    truth = SimpleNamespace(**{name: np.array(value) for name, value in vars(truth).items()})
    found = {"gain": 1.12345678, "offset": np.nan, "position_gain": 1.012}
    fit = SimpleNamespace(
        names=("elbow",),
        value=lambda name: np.array([found[name]]),
        ci95=lambda name: np.array([[found[name] - 0.5, found[name] + 0.5]]),
        reasons={("elbow", "offset"): "no sweep tells it"},
    )
    simulated = SimpleNamespace(true_friction=np.zeros(1))
    demo, account = Demo.__new__(Demo), Account(None)
    demo.bench, demo.account = SimpleNamespace(simulated=simulated, arm=None, creeping=False), account
    monkeypatch.setattr("calib.report.calibration.sections", lambda done: [])
    demo._tell_sensors([], fit, None, truth)
    made = account.summary
    assert {name: (each["true"], each["estimated"], each["ci95"]) for name, each in made["sensors"].items()} == {
        "gain": ([1.1], [1.123457], [[0.6234568, 1.623457]]),
        "offset": ([0.2], [pytest.approx(np.nan, nan_ok=True)], [None]),
        "position_gain": ([1.01], [1.012], [[0.512, 1.512]]),
    }
    assert made["not_identifiable"] == {"elbow.offset": "no sweep tells it"}
    assert made["drift"] is None


def test_its_records_are_signed_with_the_command() -> None:
    assert BY == "armlink demo"
