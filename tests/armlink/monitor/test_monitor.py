"""The monitor as a host on a bus that returns what it sends."""

import os

import can
import pytest

from armlink.bus.open import open_link_bus
from armlink.monitor.monitor import Monitor


@pytest.mark.parametrize("stats", [False, True])
def test_its_own_syncs_count_once_on_a_bus_that_returns_them(arm_of, stats):
    options = {"port": 46200 + os.getpid() % 1000}
    bus = {"interface": "udp_multicast", "channel": "239.74.163.49", "options": options}
    arm = arm_of(2, link={"bus": bus, "rate": 100})
    opened = open_link_bus(None, arm.require_link())
    try:
        monitor = Monitor(arm, opened, sync=True, stats=stats)
        view = monitor.watch(0.5)
        assert monitor.frames == 1 + 50  # NMT start and SYNCs
        assert view.rate_hz <= 101.0
        assert (monitor.cycle_stats and monitor.cycle_stats.report()["cycles"]) == (49 if stats else None)
    finally:
        opened.shutdown()


def test_frames_that_waited_before_the_first_view_are_not_counted_in_its_rate(arm_of):
    """A process that starts slowly, such as a command, opens the bus long before it watches."""
    arm = arm_of(2, link={"bus": {"interface": "virtual", "channel": "waiting"}, "rate": 100})
    opened, host = open_link_bus(None, arm.require_link()), can.Bus(interface="virtual", channel="waiting")
    try:
        monitor = Monitor(arm, opened)
        for _ in range(1500):
            host.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        view = monitor.watch(0.05)
        assert monitor.frames == 1500
        assert view.rate_hz == view.load == 0.0
    finally:
        host.shutdown()
        opened.shutdown()
