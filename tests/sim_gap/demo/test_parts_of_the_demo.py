"""Parts of the demo that need no simulated arm: the joint that drifts, its summary."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.observer.decision import Event
from calib.observer.watch_loop import WatchHistory
from sim_gap.demo.bench import drifting_joint
from sim_gap.demo.run import BY, Account, Demo, last_word


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
        "offset": ([0.2], [None], [None]),
        "position_gain": ([1.01], [1.012], [[0.512, 1.512]]),
    }
    assert made["not_identifiable"] == {"elbow.offset": "no sweep tells it"}
    assert made["drift"] is None


def test_a_drift_that_stays_has_its_reason() -> None:
    history = WatchHistory(events=[Event(3.0, "undecided", "j1", {"reasons": ["the gain is known only to ± 2 %"]})])
    assert last_word(history, 2.0) == "j1: the calibration was not changed: the gain is known only to ± 2 %"
    assert last_word(history, 4.0) == "the observer saw no change"


def test_its_records_are_signed_with_the_command() -> None:
    assert BY == "armlink demo"
