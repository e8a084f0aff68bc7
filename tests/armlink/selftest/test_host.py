"""The measurement of a host: a process that makes cycles beside one that computes."""

from armlink.arm_file import load_arm
from armlink.selftest.host import measure_host


def test_the_cycles_of_the_time_asked_are_measured():
    arm = load_arm("sarcos")
    report = measure_host(arm, 0.2)
    assert report.rate == arm.require_link().rate
    assert report.seconds == 0.2
    assert 1 <= sum(report.lateness.counts) <= 0.2 * report.rate + 2
