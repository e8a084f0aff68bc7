"""Rows of the last minutes: dropped when old, begun again when the clock restarts, thinned from the newest."""

import numpy as np

from armlink.link.types import Stats
from armlink.loop.messages import CHANNELS, Batch
from calib.daemon.state.arm_state import WINDOW_SECONDS, LiveWindow


def batch(t: float, temperature: float | None = 30.0) -> Batch:
    rows = {name: np.full((2, 1), t + k) for k, name in enumerate(CHANNELS)}
    warm = None if temperature is None else np.array([temperature])
    return Batch(np.array([t - 0.05, t]), rows, np.zeros(1, int), np.zeros(1), Stats(), temperature=warm)


def test_rows_older_than_the_window_are_dropped() -> None:
    window = LiveWindow(1)
    for k in range(5000):
        window.append(batch(0.25 * k))
    t, channels = window.rows(1e6, 10_000)
    assert (t[-1], len(t)) == (0.25 * 4999, round(4 * WINDOW_SECONDS) + 1)
    np.testing.assert_array_equal(channels["position"][:, 0], t)
    np.testing.assert_array_equal(channels["torque"][:, 0], t + 2)
    np.testing.assert_array_equal(channels["temperature"], 30.0)


def test_a_part_of_it_thinned_with_the_newest() -> None:
    window = LiveWindow(1)
    for k in range(101):
        window.append(batch(float(k), None))
    t, channels = window.rows(50.0, 10)
    np.testing.assert_array_equal(t, [52.0, 58.0, 64.0, 70.0, 76.0, 82.0, 88.0, 94.0, 100.0])
    assert np.isnan(channels["temperature"]).all()
    assert window.rows(50.0, 1000)[0][0] == 50.0


def test_a_clock_that_went_back_begins_it_again() -> None:
    window = LiveWindow(1)
    for t in (5.0, 6.0, 1.0, 2.0):
        window.append(batch(t))
    np.testing.assert_array_equal(window.rows(100.0, 10)[0], [1.0, 2.0])


def test_what_is_kept_does_not_hold_the_whole_batch() -> None:
    window = LiveWindow(1)
    one = batch(1.0)
    window.append(one)
    one.channels["position"][:] = 9.0
    np.testing.assert_array_equal(window.rows(1.0, 10)[1]["position"], [[1.0]])
