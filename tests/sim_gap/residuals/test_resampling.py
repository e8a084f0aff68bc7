"""Recorded channels on an even time base: what was read, what was filled in, and how rows are thinned."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.residuals.preprocess import coverage, decimation
from sim_gap.residuals.residual_set import SHARP, near_impacts


@pytest.mark.parametrize(("hz", "lost"), [(1000.0, 0.03), (10.0, 0.3)])
def test_a_gap_of_a_few_periods_is_filled_in(hz: float, lost: float) -> None:
    """Thirty milliseconds are a gap of no channel; three periods are none of a slow one."""
    t = np.arange(0.0, 4.0, 1.0 / hz)
    values = np.where((t > 1.0) & (t < 1.0 + lost), np.nan, 1.0)[:, None]
    assert coverage(t, values, t).all()
    values[(t > 2.0) & (t < 3.0)] = np.nan
    assert not coverage(t, values, np.array([2.5])).any()


def test_rows_at_the_work_rate_stay_as_they_are_and_others_are_smoothed_first() -> None:
    x = np.random.default_rng(1).normal(size=(400, 2))
    np.testing.assert_array_equal(decimation(100.0, 1)(x), x)
    fast = np.sin(2 * np.pi * 45.0 * np.arange(400) / 100.0)[:, None]  # would look like 5 Hz
    thinned = decimation(100.0, 2)(fast)
    assert len(thinned) == 200
    assert np.abs(thinned[20:-20]).max() < 0.05


@pytest.mark.parametrize(("times", "hits"), [(2.0, True), (0.5, False)])
def test_a_gear_hits_where_the_residual_is_far_rougher_at_reversals(times: float, hits: bool) -> None:
    """The torque changes its sign at the middle of 20 s."""
    t = np.arange(0.0, 20.0, 0.02)
    residual = np.random.default_rng(1).normal(size=(len(t), 1))
    residual[np.abs(t - 10.1) < 0.45] *= times * SHARP
    reading = {"tau": (t - 10.001)[:, None]}
    s = SimpleNamespace(reading=reading, rate=50.0, step=1, n=1, filtered=lambda x: x)
    found = near_impacts(s, "tau", residual)
    assert list(found) == [0] * hits
    if hits:
        assert t[found[0]].min() == pytest.approx(9.6, abs=0.05)
        assert t[found[0]].max() == pytest.approx(10.6, abs=0.05)
