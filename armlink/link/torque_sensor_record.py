"""The torque sensor record 2100h of a controller: staged, read back bit for bit, made active by its CRC.

Written in this order: staged gain, staged offset, record id, record date, CRC-32, each read back; then `activate` = 1.
The controller computes the CRC-32 over what it holds and aborts the write where it differs; then the staged values
become the active ones. Nothing is stored to flash unless asked for (1010h:04), since flash wears.
"""

import struct
import zlib
from collections.abc import Callable
from functools import cached_property

from armlink.arm_file import ArmFile
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.sdo import NodeServices, PumpedNetwork, joint_services
from armlink.errors import BadInput
from armlink.link.cyclic_exchange import Loop
from armlink.link.types import Calibration

_CONTENT = struct.Struct("<ffII")
GAIN_RANGE = (0.5, 2.0)


def calibration_crc(gain: float, offset: float, record_id: int, date: int) -> int:
    """CRC-32 (IEEE 802.3) of gain REAL32, offset REAL32, record id U32, date U32, little endian, 16 bytes."""
    return zlib.crc32(_CONTENT.pack(gain, offset, record_id, date))


def read_record(services: NodeServices) -> Calibration:
    """The record that is active; raises BusFault."""
    read = services.read
    return Calibration(
        gain=float(read(objects.GAIN)),
        offset=float(read(objects.OFFSET)),
        record_id=int(read(objects.RECORD_ID)),
        date=int(read(objects.RECORD_DATE)),
        crc=int(read(objects.RECORD_CRC)),
    )


def write_record(services: NodeServices, calibration: Calibration, store: bool = False) -> Calibration:
    """Make a calibration the controller's active one (`store`: in flash too); returns what the controller then holds.

    Raises BadInput for values that no sensor has, BusFault if the controller holds something else than was written.
    """
    gain, offset, record_id, date = calibration.gain, calibration.offset, calibration.record_id, calibration.date
    if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
        raise BadInput(f"{services.joint}: gain {gain} for the controller: expected {GAIN_RANGE[0]} to {GAIN_RANGE[1]}")
    if not abs(offset) < 1e4:
        raise BadInput(f"{services.joint}: offset {offset} N·m for the controller: expected a finite number")
    crc = calibration_crc(gain, offset, record_id, date)
    services.write_checked(objects.STAGED_GAIN, gain)
    services.write_checked(objects.STAGED_OFFSET, offset)
    services.write_checked(objects.RECORD_ID, record_id)
    services.write_checked(objects.RECORD_DATE, date)
    services.write_checked(objects.RECORD_CRC, crc)
    services.write(objects.ACTIVATE, 1)
    services.expect(objects.GAIN, gain)
    services.expect(objects.OFFSET, offset)
    if store:
        services.write(objects.STORE_MANUFACTURER, objects.STORE_SIGNATURE)
    return read_record(services)


class TorqueSensorRecords:
    """Calibrations of all joints' controllers, by SDO: a part of whatever runs a receive loop."""

    arm: ArmFile
    _loop: Loop

    @cached_property
    def services(self) -> tuple[NodeServices, ...]:
        """SDO access to each joint's controller, in joint order; using it sends, also where one only listens."""
        network = PumpedNetwork(self._loop.send)
        self._loop.on_other = lambda can_id, data: network.notify(can_id, bytearray(data), 0.0)
        return joint_services(network, self.arm, self._pump)

    def _pump(self, done: Callable[[], bool], timeout: float) -> bool:
        """Receive until `done` (True) or until `timeout` seconds are over (False)."""
        raise NotImplementedError

    def read_calibration(self, joint: int) -> Calibration:
        """The active calibration of joint 0 … n−1; raises BusFault."""
        return read_record(self.services[joint])

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Make a calibration active in joint 0 … n−1 (`store`: in flash too); raises BadInput, BusFault.

        While the joints are enabled, the cycle goes on with the last command. Only
        `calib.install.journaled_write` calls this.
        """
        return write_record(self.services[joint], calibration, store)
