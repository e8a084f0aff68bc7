"""Figures of a cycle whose frames and times are known."""

import numpy as np
import pytest
from fake_joints import make_arm

from armlink.bus.frame_bits import frame_bits
from armlink.link.joints.groups import make_groups
from armlink.monitor.cycle_stats import CycleStats

DATA = bytes(range(8))
GROUPS = make_groups(make_arm(2))


def feed(stats, latencies, period=0.004, lost_sync=()):
    """A SYNC a period; two joints answer, the last `latency` later (None: not at all)."""
    for cycle, latency in enumerate(latencies):
        t = 100.0 + cycle * period
        if cycle in lost_sync:
            continue
        stats.take(t, 0x80, b"")
        stats.take(t + 1e-4, 0x181, DATA)
        if latency is not None:
            stats.take(t + latency, 0x182, DATA)
    stats.take(100.0 + len(latencies) * period, 0x80, b"")
    return stats.report()


def test_latencies_are_those_that_were_put_in():
    latencies = np.random.default_rng(0).uniform(0.0008, 0.0035, 2000)
    report = feed(CycleStats(GROUPS, 0.004, 1_000_000), latencies)
    assert (report["cycles"], report["missed"]) == (2000, 0)
    assert report["period_ms"] == pytest.approx(4.0)
    assert report["jitter_ms"] < 1e-6
    expected = np.percentile(latencies, (50, 99, 99.9)) * 1e3
    figures = (report["latency_p50_ms"], report["latency_p99_ms"], report["latency_p999_ms"])
    np.testing.assert_allclose(figures, expected, rtol=1e-6)
    assert sum(count for _, count in report["histogram"]) == 2000
    below = 0
    for edge, count in report["histogram"]:
        below += count
        assert below == (latencies * 1e3 <= edge).sum()


def test_missing_readings_and_missing_syncs_are_missed_cycles():
    report = feed(CycleStats(GROUPS, 0.004, 1_000_000), [0.001] * 5 + [None] * 3 + [0.001] * 5, lost_sync=(10,))
    assert report["missed"] == 4
    assert report["longest_period_ms"] == pytest.approx(8.0)
    assert report["latency_p50_ms"] == pytest.approx(1.0)


def test_the_load_is_that_of_the_bits_on_the_wire():
    report = feed(CycleStats(GROUPS, 0.004, 500_000), [0.001] * 100)
    bits = frame_bits(0x80, b"") + frame_bits(0x181, DATA) + frame_bits(0x182, DATA)
    assert report["bus_ms_per_cycle"] == pytest.approx(bits / 500)
    assert report["load"] == pytest.approx(bits / 500_000 / 0.004)


def test_without_a_whole_cycle_there_are_no_figures():
    stats = CycleStats(GROUPS, 0.004, 1_000_000)
    stats.take(1.0, 0x80, b"")
    report = stats.report()
    assert report["cycles"] == 0
    assert np.isnan(report["latency_p50_ms"])
    assert report["histogram"] == ()
