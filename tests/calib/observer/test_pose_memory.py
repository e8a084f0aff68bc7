"""What the observer remembers of poses that the arm has visited."""

import json

import numpy as np
import pytest

from calib.observer.alarms import PLACE_MEMORY, PoseMemory
from calib.observer.config import LONGEST_WINDOW, PLACE_SIZE
from calib.observer.saved_values import UNREADABLE, restored

HERE = np.array([0.3, -1.0])
MODEL, NOISE = np.array([0.04, 0.09]), np.array([0.01, 0.04])
"""Variances of the model's error and of one row [N²·m²]."""


def memory_of(rows: np.ndarray) -> PoseMemory:
    memory = PoseMemory(2)
    for row in rows:
        memory.add(HERE, row)
    return memory


@pytest.mark.parametrize("count", [1, 2, 7])
def test_the_error_expected_at_a_pose_is_the_posterior_of_the_rows_seen_there(count):
    rows = np.random.default_rng(count).normal(0.2, 0.1, (count, 2))
    memory = memory_of(rows)
    assert memory.seen(HERE) == count
    mean, variance = memory.expected(HERE, MODEL, NOISE)
    precision = 1 / MODEL + count / NOISE
    np.testing.assert_allclose(mean, rows.sum(axis=0) / NOISE / precision)
    np.testing.assert_allclose(variance, 1 / precision)


def test_nothing_is_known_of_a_pose_that_is_not_the_same_in_every_joint():
    memory = memory_of(np.full((3, 2), 0.5))
    elsewhere = HERE + np.array([0.0, 1.1 * PLACE_SIZE])
    assert memory.seen(HERE + 0.9 * PLACE_SIZE) == 3
    assert memory.seen(elsewhere) == 0
    mean, variance = memory.expected(elsewhere, MODEL, NOISE)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(variance, MODEL)


def test_a_pose_that_is_known_well_does_not_follow_a_drift():
    memory = memory_of(np.full((PLACE_MEMORY, 2), 0.5))
    before = memory.expected(HERE, MODEL, NOISE)
    for _ in range(50):
        memory.add(HERE, np.full(2, 3.0))
    assert memory.seen(HERE) == PLACE_MEMORY
    np.testing.assert_array_equal(memory.expected(HERE, MODEL, NOISE), before)


def test_the_latest_poses_are_remembered_until_all_are_forgotten():
    memory = PoseMemory(2)
    poses = np.column_stack([np.arange(LONGEST_WINDOW + 2), np.zeros(LONGEST_WINDOW + 2)])
    for pose in poses:
        memory.add(pose, pose)
    assert [memory.seen(pose) for pose in poses] == [0, 0] + [1] * LONGEST_WINDOW
    memory.forget()
    assert not any(memory.seen(pose) for pose in poses)


def test_what_is_saved_is_known_after_a_restart():
    memory, after = memory_of(np.array([[0.5, 0.1], [0.7, 0.3]])), PoseMemory(2)
    after.restore(json.loads(json.dumps(memory.save())))
    np.testing.assert_array_equal(after.expected(HERE, MODEL, NOISE), memory.expected(HERE, MODEL, NOISE))
    for wrong in (
        {},
        {"places": 3},
        {"places": [[[1.0, 2.0]], [[1.0]], [1]]},
        {"places": [[["a", "b"]], [[1, 2]], [1]]},
    ):
        with pytest.raises(UNREADABLE):
            restored(after, wrong)
    assert after.seen(HERE) == 2
