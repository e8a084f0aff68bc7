"""Recording beside a running host: one row a SYNC, with the commands that took effect at it."""

import numpy as np
import pytest
from wiretap import Tap, conversation

from armlink.recording.recorder import Recorder

UNIT = 2 * np.pi / 2**20


def test_each_row_is_one_sync(arm_of):
    tap = Tap(conversation(9, lost=(3,)))
    rows = list(Recorder(arm_of(2), tap).rows(1.0))
    assert len(rows) == 8  # the ninth is not complete before the next SYNC
    np.testing.assert_allclose([t for t, _ in rows], np.arange(8) * 0.004, atol=1e-9)
    for cycle, (_, row) in enumerate(rows):
        second = np.nan if cycle == 3 else 1.0
        expected = np.array([2000 * cycle + 1, (2000 * cycle + 2) * second]) * UNIT
        np.testing.assert_allclose(row["position"], expected)
        np.testing.assert_allclose(row["torque"], np.array([cycle, cycle * second]))
        np.testing.assert_allclose(row["torque_command"], 0.4 * cycle)  # 10 ‰ of 40 N·m
        np.testing.assert_allclose(row["position_command"], 1000 * cycle * UNIT)
        motor = 1.0 if cycle % 4 == 0 else np.nan
        np.testing.assert_allclose(row["motor_torque"], [motor, np.nan])


def test_without_a_sync_there_is_no_row(arm_of):
    assert list(Recorder(arm_of(2), Tap([])).rows(1.0)) == []


def test_short_command_frames_are_not_decoded(arm_of):
    frames = [(100.0, 0x201, b"\x0f"), (100.001, 0x80, b""), (100.002, 0x80, b"")]
    ((_, row),) = Recorder(arm_of(2), Tap(frames)).rows(1.0)
    assert np.isnan(row["torque_command"]).all()


@pytest.mark.parametrize("seconds", [0.0101, 0.05])
def test_it_ends_when_the_time_is_over(arm_of, seconds):
    tap = Tap(conversation(100))
    rows = list(Recorder(arm_of(2), tap).rows(seconds))
    assert len(rows) == int((seconds - 0.0011) / 0.004)
