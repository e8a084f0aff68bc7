"""Our host drives the mock device of odrive-can, which shares no code with us, on a virtual bus of python-can."""

import asyncio
import math
import threading

import can
import pytest
from odrive_can.mock import ODriveCANMock
from real_host import Host

from armlink.arm_file import Bus, load_arm
from armlink.bus.open import open_bus
from armlink.drives.odrive.drives import ODriveDrives
from armlink.drives.orders import Limits, Mode, Order, Power

CHANNEL = "odrive-mock"


@pytest.fixture
def mock():
    device = ODriveCANMock(axis_id=1, can_bus=can.Bus(interface="virtual", channel=CHANNEL))
    loop = asyncio.new_event_loop()
    main = loop.create_task(device.main())

    def run():
        asyncio.set_event_loop(loop)
        with pytest.raises(asyncio.CancelledError):
            loop.run_until_complete(main)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield device.odrive
    loop.call_soon_threadsafe(main.cancel)
    thread.join(10.0)
    loop.close()


def test_our_host_identifies_enables_moves_and_disables_it(mock):
    described = load_arm("six-odrive")
    row = described.link.joints[0]
    bus = open_bus(None, Bus(interface="virtual", channel=CHANNEL))
    try:
        drives = ODriveDrives(described, [row])
        host = Host(bus.open_port(), drives)
        assert drives.identify(host)[0].present
        found = drives.set_up(host, [Limits(3.0, 100.0, 10.0, -100.0, 100.0, 0.1, 0.02)])[0]
        assert found.modes == {Mode.POSITION}  # it has no torque message
        assert "no torque reading" in found.lost[0]
        start = found.position

        def order(position, power=Power.ON):
            return Order(power, True, Mode.POSITION, position, 0.0, 0.0, 0.0, 0.0)

        assert host.until(lambda: drives.power(0) is Power.ON, lambda: order(start))
        assert mock.control_mode == "POSITION_CONTROL"
        target = start + 3.0
        assert host.until(lambda: abs(host.latest[0] - target) < 0.05, lambda: order(target))
        assert mock.position * 2 * math.pi == pytest.approx(target, abs=0.05)
        assert host.until(lambda: drives.power(0) is Power.OFF, lambda: order(target, Power.OFF))
        assert mock.axis_state == "IDLE"
    finally:
        bus.shutdown()
