"""Stretches of motion at constant speed, cut from samples; everything else gives no row."""

import json

import numpy as np
import pytest

from calib.observer.row_makers import WIDTH, MotionDetector
from calib.observer.saved_values import read_rows, save_rows

PERIOD = 0.02


def rows_of(position, torque=None, period=PERIOD):
    """Rows of samples (K, n)."""
    detector = MotionDetector(position.shape[1])
    pull = np.zeros_like(position) if torque is None else torque
    return [row for k in range(len(position)) for row in detector.handle(k * period, position[k], pull[k])]


def velocity(row):
    return row.speed * row.direction[row.joint]


def ramp(speed, seconds=10.0, start=0.0):
    return start + speed * np.arange(0, seconds, PERIOD)


def test_a_joint_at_constant_speed_gives_a_row_every_tenth_of_a_radian():
    position = np.column_stack([ramp(0.2), np.full(500, 0.3)])
    torque = np.column_stack([5 + 2 * position[:, 0], np.full(500, 9.0)])
    rows = rows_of(position, torque)
    assert 17 <= len(rows) <= 19  # 2 rad, less what friction takes to turn round
    assert {row.joint for row in rows} == {0}
    for row in rows:
        assert velocity(row) == pytest.approx(0.2, rel=1e-6)
        assert row.torque[0] == pytest.approx(5 + 2 * row.position[0], abs=1e-9)
        assert row.position[1] == pytest.approx(0.3)
    assert np.diff([row.position[0] for row in rows]) == pytest.approx(WIDTH, abs=0.01)


def test_two_joints_that_move_give_a_row_each():
    rows = rows_of(np.column_stack([ramp(0.2), ramp(-0.1)]))
    assert [row.joint for row in rows[-2:]] == [0, 1]
    assert velocity(rows[-1]) == pytest.approx(-0.1)


def test_rest_acceleration_and_creep_below_friction_s_speed_give_none():
    t = np.arange(0, 10, PERIOD)
    assert rows_of(np.zeros((500, 2))) == []
    assert rows_of(np.column_stack([0.2 * t**2, 0 * t])) == []
    assert rows_of(np.column_stack([0.02 * t, 0 * t])) == []
    assert rows_of(np.column_stack([0.2 * t, 0.2 * t**2])) == [], "another joint that speeds up pulls at this one"


def test_after_a_reversal_friction_turns_round_first():
    there = np.concatenate([ramp(0.2, 5), 1.0 - ramp(0.2, 5)])
    rows = rows_of(np.column_stack([there, 0 * there]))
    back = [row.position[0] for row in rows if velocity(row) < 0]
    assert back
    assert max(back) < 1.0 - WIDTH / 2 - 0.02
    assert {np.sign(velocity(row)) for row in rows} == {1, -1}


def test_a_gap_in_the_samples_begins_again():
    detector, moved, torque = MotionDetector(1), ramp(0.2), np.zeros(1)
    times = np.arange(len(moved)) * PERIOD
    times[250:] += 1.0
    rows = [row for t, q in zip(times, moved, strict=True) for row in detector.handle(t, np.array([q]), torque)]
    assert all(not times[249] < row.t < times[250] for row in rows)
    assert detector.handle(times[-1] + PERIOD, np.array([np.nan]), torque) == []


def test_rows_are_saved_as_json():
    (row,) = rows_of(np.column_stack([ramp(0.2, 1.6), ramp(0.0, 1.6)]))[:1]
    (read,) = read_rows(json.loads(json.dumps(save_rows([row]))), 2)
    assert (read.joint, velocity(read), read.torque[0]) == (row.joint, velocity(row), row.torque[0])
    assert np.isnan(read.temperature).all()
    with pytest.raises(ValueError, match="joint 5"):
        read_rows([[5, [0.0, 0.0], 0.0, 0.1, None]], 2)
