"""Parts of the demo that need no simulated arm: its motion, the joint that drifts, its summary."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.demo import creep_report
from sim_gap.demo.drift import drifting_joint
from sim_gap.demo.motion import multisine
from sim_gap.demo.script import ACCELERATION, BY, RANGE_SHARE, SPEED_SHARE


def test_its_motion_keeps_range_speed_and_acceleration() -> None:
    link = SimpleNamespace(rate=200.0, period=0.005)
    limits = [SimpleNamespace(max_velocity=speed) for speed in (1.0, 8.0)]
    arm = SimpleNamespace(require_link=lambda: SimpleNamespace(joints=limits))
    described = SimpleNamespace(n=2, lower=np.array([-1.0, -3.0]), upper=np.array([1.0, 2.0]))
    q = multisine(SimpleNamespace(arm=arm, described=described, link=link), 30.0, 1)
    v = np.diff(q, axis=0) * link.rate
    a = np.diff(v, axis=0) * link.rate
    middle = 0.5 * (described.lower + described.upper)
    assert (np.abs(q - middle) <= RANGE_SHARE * 0.5 * (described.upper - described.lower) + 1e-9).all()
    faded_in = slice(round(5.0 * link.rate), None)
    assert (np.abs(v[faded_in]) <= SPEED_SHARE * np.array([1.0, 8.0]) + 1e-6).all()
    assert np.abs(a[faded_in]).max() <= ACCELERATION + 1e-6
    assert (np.ptp(q, axis=0) > 0.05).all()


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
    truth = SimpleNamespace(gain=np.array([1.1]), offset=np.array([0.2]), position_offset=np.array([0.01]))
    fit = SimpleNamespace(value=lambda family: np.array([0.5]), findings=())
    told = {"gain": 1.12, "offset": 0.21, "zero": 0.012}
    monkeypatch.setattr(creep_report, "values_told", lambda fit, family: np.array([told[family]]))
    monkeypatch.setattr(creep_report, "_intervals", lambda result, family: [[0.0, 1.0]])
    monkeypatch.setattr(creep_report, "missing", lambda fit: {})
    run = SimpleNamespace(truth=truth, to_json=lambda more: more)
    found = creep_report.summary(SimpleNamespace(fit=fit, run=run, coulomb=np.array([0.4]), sag=None))["sensors"]
    assert {name: (each["true"], each["estimated"]) for name, each in found.items()} == {
        "gain": ([1.1], [1.12]),
        "offset": ([0.2], [0.21]),
        "position_offset": ([0.01], [0.012]),
    }


def test_its_records_are_signed_with_the_command() -> None:
    assert BY == "armlink demo"
