"""The drive of each family is found on a bus in real time, by an end of the bus that knows nothing of it."""

import os

import pytest
from serving import drives, served

from armlink.arm_file import Bus
from armlink.bus.open import open_bus
from armlink.drives.discovery import BusDrives

FOUND = {
    "damiao": ("id 02h", {"id": 2, "reply": 0x12, "model": "DM4340"}),
    "robstride": ("motor 3", {"id": 3, "model": "RS01"}),
    "moteus": ("controller 4", {"id": 4}),
    "odrive": ("node 5", {"node": 5}),
}


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
@pytest.mark.parametrize("kind", FOUND)
def test_it_is_found(kind, interface):
    fd = kind == "moteus"
    group = f"239.74.174.{os.getpid() % 200 + 1}"
    multicast = Bus(interface=interface, channel=group, fd=fd) if interface == "udp_multicast" else None
    with served(drives(2.0)[kind], fd, bus=multicast) as arm:
        opened = open_bus(None, multicast or Bus(interface=interface, channel=arm.channel, fd=fd))
        try:
            bus = BusDrives(opened)
            found, positions = bus.found, bus.positions()
        finally:
            opened.shutdown()
        address, keys = FOUND[kind]
        assert [(each.family, each.address) for each in found] == [(kind, address)]
        assert keys.items() <= found[0].drive.items()
        assert positions == {address: pytest.approx(arm.drive.motor.position, abs=0.05)}
        assert not arm.drive.motor.powered
        assert arm.drive.flash_writes == 0
