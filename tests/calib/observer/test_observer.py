"""The observer on synthetic stops: drift found and measured, everything else held, nothing invented."""

import json
from pathlib import Path

import numpy as np
import pytest
from observed_stops import POSE_SECONDS, SIGMA, Bench, kinds

from calib.motion.static_reading import StaticReading
from calib.observer.config import ObserverConfig
from calib.observer.observer import PLACE_ROWS, Observer
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_regressor, gravity_torque


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", range(4))
def test_a_gain_and_an_offset_drift_at_once_are_found_and_put_right(sarcos, sarcos_beta, seed) -> None:
    bench = Bench(sarcos, sarcos_beta, seed)
    bench.work(25)
    bench.drift(2, gain=1.03, offset=0.3)
    events = bench.work(100)
    assert kinds(events)[0] == "alarm"
    assert next(event.joint for event in events if event.kind == "proposal") == "joint_3"
    assert {event.joint for event in events if event.kind == "proposal"} == {"joint_3"}
    gain_error, offset_error = bench.error(2)
    assert gain_error <= 0.003
    assert offset_error <= 0.05


def test_the_proposal_comes_two_windows_after_the_alarm(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 1)
    bench.work(20)
    bench.drift(2, gain=1.03, offset=0.3)
    events = bench.work(60)
    alarm = next(event.t for event in events if event.kind == "alarm")
    proposal = next(event for event in events if event.kind == "proposal")
    assert alarm <= 22 * POSE_SECONDS
    assert proposal.t - alarm == pytest.approx(2 * bench.observer.config.window * POSE_SECONDS)
    assert proposal.evidence["gain"] == pytest.approx(1.03, abs=0.003)
    assert proposal.evidence["offset"] == pytest.approx(0.3, abs=0.05)


@pytest.mark.sample(2)
@pytest.mark.parametrize("joint", range(7))
def test_an_offset_drift_of_any_joint_is_put_right(sarcos, sarcos_beta, joint) -> None:
    bench = Bench(sarcos, sarcos_beta, 10 + joint)
    bench.work(40)
    bench.drift(joint, offset=-0.2)
    bench.work(120)
    gain_error, offset_error = bench.error(joint)
    assert gain_error <= 0.003
    assert offset_error <= 0.05


@pytest.mark.long
def test_without_drift_nothing_is_proposed(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 20)
    assert "proposal" not in kinds(bench.work(1000))


def test_a_payload_is_reported_and_held_and_never_written(sarcos, sarcos_beta) -> None:
    at_origin, by_point = payload_columns(sarcos)
    for seed, mass in enumerate([0.1, 0.5, 1.0, 3.0]):
        bench = Bench(sarcos, sarcos_beta, 30 + seed)
        bench.work(40)
        held = bench.observer.estimate()
        moment = mass * (at_origin + by_point @ [0.05, -0.1, 0.1])
        bench.extra = lambda q, moment=moment: gravity_regressor(sarcos, q) @ moment
        events = bench.work(80)
        verdicts = [event for event in events if event.kind == "verdict"]
        assert [event.evidence["cause"] for event in verdicts] == ["payload"]
        assert verdicts[0].evidence["values"][0] == pytest.approx(mass, abs=0.03)
        assert "proposal" not in kinds(events)
        np.testing.assert_array_equal(bench.observer.estimate().gain, held.gain)
        bench.extra = lambda q: np.zeros(7)
        assert bench.work(40)[-1].evidence["cause"] == "none"  # put down again
        assert not bench.observer.held


def test_a_drift_after_a_payload_is_still_found(sarcos, sarcos_beta) -> None:
    at_origin, _ = payload_columns(sarcos)
    bench = Bench(sarcos, sarcos_beta, 40)
    bench.extra = lambda q: gravity_regressor(sarcos, q) @ at_origin
    bench.work(60)
    bench.extra = lambda q: np.zeros(7)
    bench.work(60)
    bench.drift(1, offset=0.5)
    assert "proposal" in kinds(bench.work(100))
    assert bench.error(1)[1] <= 0.05


def test_a_collision_is_not_drift(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 50)
    bench.work(40)
    push = payload_columns(sarcos)[0] * 3.0
    bench.extra = lambda q: gravity_regressor(sarcos, q) @ push * bench.random.normal()
    events = bench.work(2)
    bench.extra = lambda q: np.zeros(7)
    events += bench.work(40)
    assert kinds(events)[0] == "alarm"
    assert "proposal" not in kinds(events)
    assert events[-1].evidence["cause"] == "none"


@pytest.mark.long
def test_a_slow_drift_is_followed(sarcos, sarcos_beta) -> None:
    """2 % an hour on one joint for half an hour."""
    bench = Bench(sarcos, sarcos_beta, 60)
    bench.work(60)
    worst = 0.0
    for _ in range(45):
        bench.drift(3, gain=1.0 + 0.01 / 45)
        bench.work(20)
        worst = max(worst, bench.error(3)[0])
    assert worst < 0.005


@pytest.mark.long
def test_a_step_and_a_ramp_on_two_joints_at_once_are_put_right(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 65)
    bench.work(40)
    bench.drift(1, offset=0.5)
    for _ in range(60):
        bench.drift(2, gain=1.0 + 0.03 / 60)
        bench.work(1)
    bench.work(200)
    for joint in range(7):
        gain_error, offset_error = bench.error(joint)
        assert gain_error <= 0.003
        assert offset_error <= 0.05


def test_three_joints_that_change_alike_are_not_written(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 70)
    bench.work(40)
    for joint in range(7):
        bench.drift(joint, gain=1.02)
    events = bench.work(100)
    assert "proposal" not in kinds(events)
    assert "verdict" in kinds(events)


def test_a_long_rest_and_a_repeated_pose_do_not_wind_it_up(sarcos, sarcos_beta) -> None:
    """Two poses of a pick-and-place, a thousand times: uncertainty stays what two poses can tell."""
    bench = Bench(sarcos, sarcos_beta, 80)
    poses = bench.random.uniform(sarcos.lower, sarcos.upper, (2, 7))
    for k in range(1000):
        q = poses[k % 2]
        reading = gravity_torque(sarcos, sarcos_beta, q) + SIGMA * bench.random.normal(size=7)
        assert bench.observer.handle_row(StaticReading.of(2.0 * k, q, reading, np.ones(7))) == []
    assert bench.observer.estimate().accepted.max() <= 2 * PLACE_ROWS
    assert bench.observer.estimate().offset_std.min() > 1e-3


def test_drift_approached_from_one_side_only_is_undecided(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 90)
    bench.work(20)
    bench.drift(2, offset=0.3, gain=1.03)
    bench.directions = (1.0,)
    events = bench.work(100)
    assert "proposal" not in kinds(events)


def test_writes_keep_their_distance(sarcos, sarcos_beta) -> None:
    """Under policy observe nobody installs: the proposal is repeated, but not more often than the rate limit."""
    config = ObserverConfig(rest_between_writes=200.0)
    bench = Bench(sarcos, sarcos_beta, 100, config)
    bench.work(20)
    bench.drift(2, gain=1.03, offset=0.3)
    times = [event.t for event in bench.work(400, apply=False) if event.kind == "proposal"]
    assert len(times) >= 2
    assert np.diff(times).min() >= 200.0


def test_estimates_show_the_drift_before_it_is_put_right(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 110)
    bench.work(20)
    bench.drift(2, gain=1.03, offset=0.3)
    bench.work(60, apply=False)
    estimate = bench.observer.estimate()
    assert abs(estimate.gain[2] - 1.03) < 5 * estimate.gain_std[2] < 0.01
    assert abs(estimate.offset[2] - 0.3) < 5 * estimate.offset_std[2] < 0.1


def test_the_same_samples_give_the_same_events(sarcos, sarcos_beta) -> None:
    def run() -> list[tuple[float, str]]:
        bench = Bench(sarcos, sarcos_beta, 120)
        bench.work(20)
        bench.drift(2, gain=1.03, offset=0.3)
        return [(event.t, event.kind) for event in bench.work(80)]

    assert run() == run()


def test_position_gain_and_offset_are_applied(sarcos, sarcos_beta) -> None:
    gain, offset = np.full(7, 1.01), np.full(7, 0.02)
    observer = Observer.at_rest(
        sarcos, sarcos_beta, np.zeros((14, 14)), SIGMA, None, lambda reading: gain * reading + offset
    )
    random = np.random.default_rng(0)
    for k in range(60):
        q = random.uniform(sarcos.lower, sarcos.upper)
        reading = gravity_torque(sarcos, sarcos_beta, q) + SIGMA * random.normal(size=7)
        assert (
            observer.handle_row(StaticReading.of(2.0 * k, (q - offset) / gain, reading, random.choice([-1.0, 1.0], 7)))
            == []
        )


@pytest.mark.long
def test_a_payload_that_stays_becomes_a_tool_and_drift_is_seen_again(sarcos, sarcos_beta) -> None:
    at_origin, by_point = payload_columns(sarcos)
    bench = Bench(sarcos, sarcos_beta, 130, ObserverConfig(tool_windows=5))
    bench.work(60)
    moment = 1.2 * (at_origin + by_point @ [0.05, -0.1, 0.1])
    bench.extra = lambda q: gravity_regressor(sarcos, q) @ moment
    verdicts = [event.evidence for event in bench.work(140) if event.kind == "verdict"]
    assert [verdict["cause"] for verdict in verdicts] == ["payload", "tool"]
    assert verdicts[1]["com"] == pytest.approx([0.05, -0.1, 0.1], abs=0.01)
    assert not bench.observer.held
    bench.drift(2, gain=1.03, offset=0.3)
    bench.work(120)
    assert bench.error(2)[0] <= 0.003
    assert bench.error(2)[1] <= 0.05
    bench.extra = lambda q: np.zeros(7)  # and when it is taken off
    verdicts = [event.evidence for event in bench.work(80) if event.kind == "verdict"]
    assert verdicts[0]["cause"] == "tool"
    assert verdicts[0]["mass"] == pytest.approx(-1.2, abs=0.03)
    assert not bench.observer.held
    assert "proposal" not in kinds(bench.work(200))


def test_zeros_that_move_together_are_temperature_and_not_written(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 140)
    bench.work(60)
    held = bench.observer.estimate()
    for joint, offset in enumerate([0.6, -0.5, 0.4, 0.3, -0.2, 0.2, 0.1]):
        bench.drift(joint, offset=offset)
    events = bench.work(100)
    assert "temperature" in [event.evidence["cause"] for event in events if event.kind == "verdict"]
    assert "proposal" not in kinds(events)
    np.testing.assert_array_equal(bench.observer.estimate().offset, held.offset)
    for joint in range(7):
        bench.offset[joint] = 0.0
    assert bench.work(60)[-1].evidence["cause"] == "none"


@pytest.mark.sample(1)
@pytest.mark.parametrize("rows", [95, 15, 75])
def test_a_restored_observer_goes_on_as_if_nothing_had_been(sarcos, sarcos_beta, rows) -> None:
    """In quiet work, under an alarm, and between two windows that agree."""

    def run(restart: bool) -> list[tuple[float, str]]:
        bench = Bench(sarcos, sarcos_beta, 150)
        bench.work(60)
        bench.drift(2, gain=1.03, offset=0.3)
        bench.work(rows - 60 if rows > 60 else 0)
        if restart:
            saved = json.loads(json.dumps(bench.observer.save()))
            again = Observer.at_rest(sarcos, sarcos_beta, np.zeros((14, 14)), SIGMA)
            assert again.restore(saved)
            bench.observer = again
        bench.work(80)
        return [(event.t, event.kind) for event in bench.events]

    assert run(True) == run(False)


def test_a_state_that_does_not_fit_changes_nothing(sarcos, sarcos_beta) -> None:
    bench = Bench(sarcos, sarcos_beta, 160)
    bench.work(30)
    good = bench.observer.save()
    for change in ({"schema": 99}, {"sigma": [1.0]}, {"state": [[float("nan"), 0.0]] * 7}, {"window": [[1.0]]}):
        assert not bench.observer.restore({**good, **change})
    assert not bench.observer.restore({})
    assert bench.observer.save() == good


def test_a_state_saved_by_version_0_1_is_restored(sarcos, sarcos_beta) -> None:
    """saved_state.json: a drift of joint 3, between two windows that agree; written by armlink 0.1."""
    saved = json.loads((Path(__file__).parent / "saved_state.json").read_text(encoding="utf-8"))
    bench = Bench(sarcos, sarcos_beta, 150)
    bench.work(60)
    bench.drift(2, gain=1.03, offset=0.3)
    bench.work(35)
    bench.observer = Observer.at_rest(sarcos, sarcos_beta, np.zeros((14, 14)), SIGMA)
    assert bench.observer.restore(saved)
    again = bench.observer.save()
    former = {"learnt", "recent", "rejected"}
    assert {key: again[key] for key in saved.keys() - former} == {key: saved[key] for key in saved.keys() - former}
    assert [(event.t, event.kind, event.joint) for event in bench.work(80)] == [(200.0, "proposal", "joint_3")]


@pytest.mark.parametrize(
    "part", ["beta", "factor", "state", "sums", "places", "window", "first", "said", "direction", "left"]
)
def test_a_part_that_does_not_fit_leaves_the_others_as_they_were(sarcos, sarcos_beta, part) -> None:
    saved = json.loads((Path(__file__).parent / "saved_state.json").read_text(encoding="utf-8"))
    observer = Observer.at_rest(sarcos, sarcos_beta, np.zeros((14, 14)), SIGMA)
    before = observer.save()
    assert not observer.restore({**saved, part: [["x"]]})
    assert observer.save() == before
