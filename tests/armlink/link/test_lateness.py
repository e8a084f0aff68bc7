"""How late cycles began: the percentiles of the histogram, and when a host is warned of."""

import math

import pytest

from armlink.link.lateness import Lateness


def counted(*late: float) -> Lateness:
    found = Lateness()
    for each in late:
        found.add(each)
    return found


def bin_of(late: float) -> int:
    return counted(late).counts.index(1)


@pytest.mark.parametrize("late", [2e-5, 1e-4, 1e-3, 0.03])
def test_a_percentile_is_the_upper_end_of_its_bin(late):
    end = counted(late, 1.0).percentile(0.5)
    assert late <= end <= 1.05 * late + 1e-6
    assert bin_of(end * (1 - 1e-6)) == bin_of(late)
    assert bin_of(end * (1 + 1e-6)) == bin_of(late) + 1


def test_a_share_that_is_reached_exactly_is_reached():
    late = counted(1e-3, 1e-3, 0.1, 0.1)
    assert late.percentile(0.5) < 2e-3
    assert late.percentile(0.5 + 1e-9) == 0.1  # no more than the longest
    assert late.percentile(1.0) == 0.1
    assert counted().percentile(0.999) == 0.0
    assert math.isclose(counted(0.0, -1.0, 0.0, 5.0).percentile(0.75), 1e-5 * (2 ** (1 / 16) - 1))
