"""Frames of Damiao DM-J drives: bytes to SI values and back, without a bus.

Sources: enactic/openarm_can (`dm_motor_control.cpp`), the maker's register table as in python-damiao-driver.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

from armlink.drives.mit_packing import Grid, MitFeedback, Ranges, pack_feedback, unpack_feedback

REGISTERS_ID = 0x7FF
"""Identifier of register requests to any drive."""
READ, WRITE, REFRESH = 0x33, 0x55, 0xCC
OTHER_MODES = {0x100: "position", 0x200: "velocity", 0x300: "force"}
"""Offsets of the command ids of the modes that armlink does not use."""


class DamiaoRegister(IntEnum):
    """Registers that armlink uses; all can be read."""

    TORQUE_CONSTANT = 1
    OVER_CURRENT = 3
    REPLY_ID = 7
    COMMAND_ID = 8
    TIMEOUT = 9
    CONTROL_MODE = 10
    HARDWARE_VERSION = 13
    SOFTWARE_VERSION = 14
    SERIAL_NUMBER = 15
    GEAR_RATIO = 20
    POSITION_RANGE = 21
    VELOCITY_RANGE = 22
    TORQUE_RANGE = 23
    LARGEST_CURRENT = 59


INTEGER_REGISTERS = frozenset((7, 8, 9, 10, 13, 14, 15, 16, 35, 36))
"""Registers with a 32-bit unsigned value; all others are floats."""
TIMEOUT_UNIT = 50e-6
"""Unit of register 9 [s]; 0 switches the deadman off."""
MIT_MODE = 1
"""Value of register 10 in which MIT frames are understood."""
MODELS: dict[str, Ranges] = {
    "DM3507": Ranges(12.566, 50.0, 5.0),
    "DM4310": Ranges(12.5, 30.0, 10.0),
    "DM4310P": Ranges(12.5, 50.0, 10.0),
    "DM4340": Ranges(12.5, 10.0, 28.0),
    "DM4340P": Ranges(12.5, 10.0, 28.0),
    "DM6006": Ranges(12.5, 45.0, 20.0),
    "DM8006": Ranges(12.5, 45.0, 40.0),
    "DM8009": Ranges(12.5, 45.0, 54.0),
    "DM10010": Ranges(12.5, 20.0, 200.0),
    "DM10010L": Ranges(12.5, 25.0, 200.0),
    "DMH3510": Ranges(12.5, 280.0, 1.0),
    "DMH6215": Ranges(12.5, 45.0, 10.0),
    "DMG6220": Ranges(12.5, 45.0, 10.0),
    "DM6248P": Ranges(12.566, 20.0, 120.0),
}
"""Ranges as delivered, by the name on the label: PMAX [rad], VMAX [rad/s], TMAX [N·m] (registers 21 to 23).

They are taken only where the drive cannot be asked: to listen beside another host, until its registers are heard. A
start always reads the registers. Source: the maker's register defaults as in python-damiao-driver 1.0.6 and DM_CAN.py.
"""
VALUES = struct.Struct("<I"), struct.Struct("<f")


class DamiaoStatus(IntEnum):
    """State nibble of a reply."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVERVOLTAGE = 0x8
    UNDERVOLTAGE = 0x9
    OVERCURRENT = 0xA
    POWER_STAGE_TOO_HOT = 0xB
    MOTOR_TOO_HOT = 0xC
    LOST_COMMUNICATION = 0xD
    OVERLOAD = 0xE


class DamiaoReply(NamedTuple):
    """Reply to a command: state nibble, feedback, temperatures of power stage and rotor [°C]."""

    drive: int
    """Low nibble of the drive's command id."""
    state: int
    feedback: MitFeedback
    stage_temperature: int
    rotor_temperature: int


def read_request(drive: int, register: int) -> bytes:
    """Read a register of the drive with command id `drive`."""
    return struct.pack("<HBB4x", drive, READ, register)


def write_request(drive: int, register: int, value: float) -> bytes:
    """Write a register in RAM; flash is never written."""
    return struct.pack("<HBB4s", drive, WRITE, register, pack_value(register, value))


def refresh_request(drive: int) -> bytes:
    return struct.pack("<HB5x", drive, REFRESH)


def pack_value(register: int, value: float) -> bytes:
    return VALUES[0].pack(int(value)) if register in INTEGER_REGISTERS else VALUES[1].pack(value)


def unpack_value(register: int, data: bytes) -> float:
    value: float = VALUES[register not in INTEGER_REGISTERS].unpack(data)[0]
    return value


def register_answer(data: bytes, drive: int) -> tuple[int, int, float] | None:
    """(READ or WRITE, register, value) of an answer from `drive`, or None.

    A reply about the motion can have the same bytes, of a drive near the lower end of its range; hence only a reader
    that waits for an answer calls this.
    """
    if len(data) != 8 or data[0] | data[1] << 8 != drive or data[2] not in (READ, WRITE):
        return None
    return data[2], data[3], unpack_value(data[3], data[4:8])


def pack_reply(reply: DamiaoReply, grid: Grid) -> bytes:
    head = reply.state << 4 | reply.drive & 0xF
    tail = (max(0, min(255, reply.stage_temperature)), max(0, min(255, reply.rotor_temperature)))
    return bytes([head]) + pack_feedback(reply.feedback, grid) + bytes(tail)


def unpack_reply(data: bytes, grid: Grid) -> DamiaoReply | None:
    if len(data) != 8:
        return None
    return DamiaoReply(data[0] & 0xF, data[0] >> 4, unpack_feedback(data[1:6], grid), data[6], data[7])
