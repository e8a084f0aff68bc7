"""Our host drives the mock device of odrive-can, which shares no code with us, on a virtual bus of python-can."""

import asyncio
import math
import threading
import time

import can
import pytest
from odrive_can.mock import ODriveCANMock

from armlink.arm_file import Bus, load_arm
from armlink.bus.open import open_bus
from armlink.drives.odrive.drives import ODriveDrives
from armlink.drives.orders import Limits, Mode, Order, Power

CHANNEL = "odrive-mock"


class Host:
    """What `set_up` asks by, in real time on a port; cycles at 50 Hz."""

    def __init__(self, port, drives):
        self.port, self.drives, self.latest = port, drives, {}

    def __call__(self, frame, answer, timeout=0.1, tries=3):
        for _ in range(tries):
            self.port.send(*frame)
            end = time.monotonic() + timeout
            while (left := end - time.monotonic()) > 0:
                came = self.port.receive(left)
                if came is not None and (found := answer(*came)) is not None:
                    return found
                if came is not None:
                    self.take(*came)
        return None

    def send(self, can_id, data):
        self.port.send(can_id, data)

    def wait(self, done, timeout):
        end = time.monotonic() + max(timeout, 5.0)  # the mock is slow to begin
        while not done() and time.monotonic() < end:
            self.listen(0.05)
        return done()

    def now(self):
        return time.monotonic()

    def take(self, can_id, data):
        if can_id in self.drives.routes():
            reading = self.drives.take(can_id, data, self.now())
            if reading is not None and math.isfinite(reading.position):
                self.latest[reading.joint] = reading.position

    def listen(self, seconds):
        while (came := self.port.receive(seconds)) is not None:
            self.take(*came)
            seconds = 0.0

    def until(self, condition, order, seconds=30.0):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            for frame in self.drives.frames([order()], self.now()):
                self.port.send(*frame)
            self.listen(0.02)
        return condition()


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
