"""Isolated spikes of a channel are found, and a diagnosis is the same with and without them."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.residuals.channel_quality import spikes_of, stuck_intervals

RATE = 250.0
T = np.arange(0.0, 40.0, 1.0 / RATE)


def torque(seed: int) -> np.ndarray:
    """A load with friction that turns, and noise [N·m]."""
    noise = np.random.default_rng(seed).normal(0.0, 0.2, T.size)
    return 20.0 * np.sin(0.6 * T) + 4.0 * np.sign(np.cos(2.0 * T)) + noise


def found(values: np.ndarray, t: np.ndarray = T) -> np.ndarray:
    return spikes_of(t, values[:, None])[:, 0]


@pytest.mark.parametrize("hold", [1, 5])
def test_spikes_are_found_where_they_are_and_nowhere_else(hold):
    drawn = np.random.default_rng(1).random(T.size // hold) < 0.002
    drawn[[0, -1]] = False
    there = np.repeat(drawn, hold)
    values = np.repeat(torque(2)[::hold], hold) + 10.0 * there
    assert there.any()
    np.testing.assert_array_equal(found(values), there)


def test_what_is_not_rare_is_the_channels_noise():
    often = np.random.default_rng(3).random(T.size) < 0.03
    assert not found(torque(2) + 10.0 * often).any()
    normal = np.random.default_rng(5).normal(0.0, 3.0, T.size)
    assert not found(torque(2) + normal).any()


def test_what_lasts_is_no_spike():
    knocked = torque(2)
    knocked[3000:3010] += 10.0
    assert not found(knocked).any()


def test_a_slow_channel_has_no_spikes():
    slow = torque(2)[::10]
    slow[500] += 10.0
    assert not found(slow, T[::10]).any()


@pytest.mark.long
def test_the_diagnosis_is_the_same_and_says_how_many_samples_it_left_out():
    wrong = Wrong(coulomb=np.array([0.0, 0.6, 0.0]))
    recordings = [record(model(), wrong, seed=seed, seconds=24.0, rate=100.0) for seed in (1, 2)]
    random, count, spoiled = np.random.default_rng(4), 0, []
    for recording in recordings:
        size = 0.2 * np.abs(recording.torque).max(0)
        changed = {}
        for name in ("torque", "motor_torque"):
            drawn = random.random(recording.torque.shape) < 0.002
            drawn[:5] = drawn[-5:] = False
            count += int(drawn.sum())
            changed[name] = getattr(recording, name) + drawn * random.choice([-1.0, 1.0], drawn.shape) * size
        spoiled.append(replace(recording, **changed))
    clean, answer = (diagnose(model(), made[:1], made[1:]) for made in (recordings, spoiled))
    assert answer.verdict == clean.verdict == "explained"
    assert [cause.effect for cause in answer.causes] == [cause.effect for cause in clean.causes] == ["friction.coulomb"]
    before, after = (made.causes[0].parameters["joint_2"]["torque"] for made in (clean, answer))
    assert after.value == pytest.approx(before.value, rel=0.03)
    told = [int(note.split(": ")[1].split()[0]) for note in answer.notes if "left out as spikes" in note]
    assert sum(told) == pytest.approx(count, rel=0.05)
    assert not any("spikes" in note for note in clean.notes)


@pytest.mark.parametrize(("step", "count"), [(0.3, 0), (0.01, 1)])
def test_a_reading_may_repeat_while_torque_changes_by_less_than_its_step(step, count):
    t = np.arange(0.0, 20.0, 0.01)
    model = 0.5 * np.sin(0.3 * t)
    reading = step * np.round(model / step)
    if count:
        reading[700:1100] = reading[700]
    assert len(stuck_intervals(t, model, np.zeros(len(t), bool), t, reading)) == count
