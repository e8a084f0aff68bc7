"""Objects of a joint controller that the link uses (CiA 301, CiA 402, torque sensor record 2100h)."""

import struct
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One object dictionary entry: index, sub-index and the struct code of its little-endian value."""

    index: int
    sub: int
    code: str
    name: str

    @property
    def bits(self) -> int:
        """Length of the value in bits, as in a PDO mapping entry."""
        return 8 * struct.calcsize("<" + self.code)

    @property
    def mapping(self) -> int:
        """PDO mapping entry: index << 16 | sub-index << 8 | bits (CiA 301, 1600h and 1A00h)."""
        return self.index << 16 | self.sub << 8 | self.bits

    @property
    def address(self) -> bytes:
        """Index and sub-index as SDO frames carry them (CiA 301, 7.2.4.3)."""
        return struct.pack("<HB", self.index, self.sub)

    def __str__(self) -> str:
        """For example `607Dh:01 lower position limit`."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


DEVICE_TYPE = Entry(0x1000, 0, "I", "device type")
DEVICE_NAME_INDEX = 0x1008
STORE_MANUFACTURER = Entry(0x1010, 4, "I", "store manufacturer parameters")
STORE_SIGNATURE = 0x65766173  # "save"
RPDO_DEADLINE = Entry(0x1400, 5, "H", "RPDO1 event timer")
HEARTBEAT_CONSUMER = Entry(0x1016, 1, "I", "heartbeat consumer time")
HEARTBEAT_PRODUCER = Entry(0x1017, 0, "H", "heartbeat producer time")
VENDOR = Entry(0x1018, 1, "I", "vendor")
PRODUCT = Entry(0x1018, 2, "I", "product code")
REVISION = Entry(0x1018, 3, "I", "revision")
SERIAL = Entry(0x1018, 4, "I", "serial number")

ABORT_OPTION = Entry(0x6007, 0, "h", "abort connection option")
CONTROL_WORD = Entry(0x6040, 0, "H", "control word")
STATUS_WORD = Entry(0x6041, 0, "H", "status word")
QUICK_STOP_OPTION = Entry(0x605A, 0, "h", "quick stop option")
MODE = Entry(0x6060, 0, "b", "mode of operation")
MODE_DISPLAY = Entry(0x6061, 0, "b", "mode of operation display")
POSITION = Entry(0x6064, 0, "i", "position")
VELOCITY = Entry(0x606C, 0, "i", "velocity")
TARGET_TORQUE = Entry(0x6071, 0, "h", "target torque")
MAX_TORQUE = Entry(0x6072, 0, "H", "max torque")
RATED_TORQUE = Entry(0x6076, 0, "I", "rated torque")
MOTOR_TORQUE = Entry(0x6077, 0, "h", "torque actual value")
TARGET_POSITION = Entry(0x607A, 0, "i", "target position")
POSITION_LOWER = Entry(0x607D, 1, "i", "lower position limit")
POSITION_UPPER = Entry(0x607D, 2, "i", "upper position limit")
PROFILE_VELOCITY = Entry(0x6081, 0, "I", "profile velocity")
TORQUE_SLOPE = Entry(0x6087, 0, "I", "torque slope")
TORQUE_OFFSET = Entry(0x60B2, 0, "h", "torque offset")
ENCODER_INCREMENTS = Entry(0x608F, 1, "I", "encoder increments")
ENCODER_REVOLUTIONS = Entry(0x608F, 2, "I", "encoder's motor revolutions")
GEAR_MOTOR = Entry(0x6091, 1, "I", "gear motor revolutions")
GEAR_SHAFT = Entry(0x6091, 2, "I", "gear shaft revolutions")
FEED = Entry(0x6092, 1, "I", "feed")
FEED_SHAFT = Entry(0x6092, 2, "I", "feed shaft revolutions")
TARGET_VELOCITY = Entry(0x60FF, 0, "i", "target velocity")
POSITION_SI_UNIT = Entry(0x60A8, 0, "I", "SI unit of positions")
VELOCITY_SI_UNIT = Entry(0x60A9, 0, "I", "SI unit of velocities")
INTERPOLATION_VALUE = Entry(0x60C2, 1, "B", "interpolation time period value")
INTERPOLATION_INDEX = Entry(0x60C2, 2, "b", "interpolation time index")
SUPPORTED_MODES = Entry(0x6502, 0, "I", "supported modes")

TORQUE_READING = Entry(0x2100, 1, "i", "torque sensor reading")
GAIN = Entry(0x2100, 2, "f", "gain")
OFFSET = Entry(0x2100, 3, "f", "offset")
STAGED_GAIN = Entry(0x2100, 4, "f", "staged gain")
STAGED_OFFSET = Entry(0x2100, 5, "f", "staged offset")
ACTIVATE = Entry(0x2100, 6, "B", "activate")
RECORD_ID = Entry(0x2100, 7, "I", "record id")
RECORD_DATE = Entry(0x2100, 8, "I", "record date")
RECORD_CRC = Entry(0x2100, 9, "I", "record CRC-32")
TEMPERATURE = Entry(0x2101, 0, "h", "drive temperature")
"""Unit 0.1 °C; optional."""

SYNC_ID = 0x80
NMT_ID = 0x000
EMCY_ID = 0x80
HEARTBEAT_ID = 0x700
SDO_REQUEST_ID, SDO_RESPONSE_ID = 0x600, 0x580
LSS_ID = 0x7E5
"""Requests of a master that sets node ids and bit rates (CiA 305)."""
NMT_START, NMT_PRE_OPERATIONAL = 0x01, 0x80
OPERATIONAL = 0x05
NMT_STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
