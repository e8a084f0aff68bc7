"""The torque sensor record 2100h of a controller: staged, read back bit for bit, made active by its CRC.

Written in this order: staged gain, staged offset, record id, record date, CRC-32, each read back; then `activate` = 1.
The controller computes the CRC-32 over what it holds and aborts the write where it differs; then the staged values
become the active ones. Nothing is stored to flash unless asked for (1010h:04), since flash wears.
"""

import struct
import zlib

from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.sdo import NodeServices
from armlink.errors import BadInput
from armlink.torque_calibration import GAIN_RANGE, Calibration

_CONTENT = struct.Struct("<ffII")


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


def require_record(services: NodeServices) -> None:
    """Raise BusFault where 2100h is not our record: another maker's device has something else there (the serial number
    of an EPOS4), and nothing is ever written to it. Every object of ours has four bytes, and a gain is a gain."""
    if not GAIN_RANGE[0] <= read_record(services).gain <= GAIN_RANGE[1]:
        raise services.fault(objects.GAIN, "is not a gain, so 2100h of this device is not the torque sensor record")


def write_record(services: NodeServices, calibration: Calibration, store: bool = False) -> Calibration:
    """Make a calibration the controller's active one (`store`: in flash too); returns what the controller then holds.

    Raises BadInput for values that no sensor has, BusFault if the controller holds something else than was written.
    """
    gain, offset, record_id, date = calibration.gain, calibration.offset, calibration.record_id, calibration.date
    calibration.require_usable(services.joint)
    for what, number in (("record id", record_id), ("date", date)):
        if not 0 <= number < 2**32:
            raise BadInput(
                f"{services.joint}: {what} {number} cannot be written to the drive: expected 0 to {2**32 - 1}"
            )
    require_record(services)
    crc = calibration_crc(gain, offset, record_id, date)
    staged = (objects.STAGED_GAIN, objects.STAGED_OFFSET, objects.RECORD_ID, objects.RECORD_DATE, objects.RECORD_CRC)
    for entry, value in zip(staged, (gain, offset, record_id, date, crc), strict=True):
        services.write_checked(entry, value)
    services.write(objects.ACTIVATE, 1)
    services.expect(objects.GAIN, gain)
    services.expect(objects.OFFSET, offset)
    if store:
        services.write(objects.STORE_MANUFACTURER, objects.STORE_SIGNATURE)
    return read_record(services)
