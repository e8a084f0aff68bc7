"""Frames of RobStride drives in the private protocol: 29-bit identifiers, eight bytes.

Identifier: type (5 bits) << 24 | 16 bits of data << 8 | target (8 bits). Source: the maker's manuals of 2026-04-28,
chapters 4 and 5.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

from armlink.drives.mit_packing import Grid, MitCommand, MitFeedback, Ranges, grid_of

RANGES = {
    "RS00": Ranges(12.57, 33.0, 14.0),
    "RS01": Ranges(12.57, 44.0, 17.0),
    "RS02": Ranges(12.57, 44.0, 17.0),
    "RS03": Ranges(12.57, 20.0, 60.0, 5000.0, 100.0),
    "RS04": Ranges(12.57, 15.0, 120.0, 5000.0, 100.0),
    "RS05": Ranges(12.57, 50.0, 5.5),
    "RS06": Ranges(12.57, 50.0, 36.0, 5000.0, 100.0),
}
"""Ranges by model, from the manuals: these drives have no register for them."""
MOTION_BITS = (16, 16, 16, 16, 16)
"""Bits of q, dq, kp, kd and τ in the private protocol."""
MOTION = struct.Struct(">4H")
GRIDS = {model: grid_of(ranges, MOTION_BITS) for model, ranges in RANGES.items()}
"""Steps that the frames of each model can carry."""
OUR_ID, IDENTITY_TARGET = 0xFD, 0xFE
"""Id that asks, and that all answers to type 0 go to."""
NEVER_READ = 0x01
"""Bits 16 to 23 of the identifier that answers the reading of an unknown parameter."""


class Type(IntEnum):
    IDENTITY = 0
    MOTION = 1
    FEEDBACK = 2
    ENABLE = 3
    STOP = 4
    SET_ZERO = 6
    SET_ID = 7
    READ = 17
    WRITE = 18
    SAVE = 22
    REPORT = 24


class RobStrideParameter(IntEnum):
    RUN_MODE = 0x7005
    LIMIT_TORQUE = 0x700B
    LIMIT_CURRENT = 0x7018
    POSITION = 0x7019
    CURRENT = 0x701A
    VELOCITY = 0x701B
    BUS_VOLTAGE = 0x701C
    TIMEOUT = 0x7028
    ZERO_STATE = 0x7029


INTEGERS = {0x7005: "<B3x", 0x7028: "<I", 0x7029: "<B3x"}
"""Layout of the parameters that are no floats."""
TIMEOUT_UNIT = 1.0 / 20000
"""Unit of canTimeout [s]; 0, the default, switches the deadman off."""
MOTION_MODE = 0
"""Value of run_mode in which motion commands are understood."""


class RunMode(IntEnum):
    RESET = 0
    CALIBRATION = 1
    RUN = 2


FAULTS = ("undervoltage", "overcurrent", "overtemperature", "encoder", "stall overload", "uncalibrated")
"""Bits 16 to 21 of feedback's identifier, from the lowest."""


class Feedback(NamedTuple):
    """Feedback (type 2) and report (type 24)."""

    drive: int
    faults: int
    mode: int
    motion: MitFeedback
    temperature: float
    """[°C]."""


def identifier(kind: int, data: int, target: int) -> int:
    """29-bit identifier, without a flag."""
    return kind << 24 | (data & 0xFFFF) << 8 | target & 0xFF


def kind_of(can_id: int) -> int:
    return can_id >> 24 & 0x1F


def data_of(can_id: int) -> int:
    return can_id >> 8 & 0xFFFF


def motion_frame(drive: int, q: int, dq: int, kp: int, kd: int, torque: int) -> tuple[int, bytes]:
    """Motion command (type 1) of packed steps: the torque is in the identifier."""
    return identifier(Type.MOTION, torque, drive), MOTION.pack(q, dq, kp, kd)


def unpack_motion(can_id: int, data: bytes, grid: Grid) -> MitCommand:
    """A motion command as the drive understands it; `data` has eight bytes."""
    q, dq, kp, kd = MOTION.unpack(data)
    return grid.command(q, dq, kp, kd, data_of(can_id))


def enable_frame(drive: int, host: int) -> tuple[int, bytes]:
    return identifier(Type.ENABLE, host, drive), bytes(8)


def stop_frame(drive: int, host: int, clear_fault: bool = False) -> tuple[int, bytes]:
    """Stop (type 4): free; with `clear_fault` faults are cleared."""
    return identifier(Type.STOP, host, drive), bytes([clear_fault]) + bytes(7)


def identity_frame(drive: int, host: int) -> tuple[int, bytes]:
    return identifier(Type.IDENTITY, host, drive), bytes(8)


def read_frame(drive: int, host: int, parameter: int) -> tuple[int, bytes]:
    return identifier(Type.READ, host, drive), struct.pack("<H6x", parameter)


def write_frame(drive: int, host: int, parameter: int, value: float) -> tuple[int, bytes]:
    """Write a parameter in RAM (type 18); flash (type 22) is never written."""
    return identifier(Type.WRITE, host, drive), struct.pack("<H2x", parameter) + pack_value(parameter, value)


def pack_value(parameter: int, value: float) -> bytes:
    layout = INTEGERS.get(parameter)
    return struct.pack("<f", value) if layout is None else struct.pack(layout, int(value))


def unpack_value(parameter: int, data: bytes) -> float:
    value: float = struct.unpack(INTEGERS.get(parameter, "<f"), data)[0]
    return value


def parameter_answer(can_id: int, data: bytes) -> tuple[int, int, float | None] | None:
    """(drive, parameter, value) of an answer to a reading (type 17), value None where the drive has no such parameter.

    None for another frame. A drive answers zeros for a parameter that it does not know, and says so in bits 16 to 23.
    """
    if kind_of(can_id) != Type.READ or len(data) != 8:
        return None
    parameter = int(struct.unpack_from("<H", data)[0])
    unknown = can_id >> 16 & 0xFF == NEVER_READ
    return can_id >> 8 & 0xFF, parameter, None if unknown else unpack_value(parameter, data[4:8])


def pack_feedback(feedback: Feedback, host: int, grid: Grid, kind: int = Type.FEEDBACK) -> tuple[int, bytes]:
    head = feedback.drive | feedback.faults << 8 | feedback.mode << 14
    data = MOTION.pack(*grid.feedback_steps(feedback.motion), round(feedback.temperature * 10) & 0xFFFF)
    return identifier(kind, head, host), data


def unpack_feedback(can_id: int, data: bytes, grid: Grid) -> Feedback | None:
    """Feedback or report in a frame, or None for another type or length."""
    if kind_of(can_id) not in (Type.FEEDBACK, Type.REPORT) or len(data) != 8:
        return None
    q, dq, torque, temperature = MOTION.unpack(data)
    head = data_of(can_id)
    return Feedback(head & 0xFF, head >> 8 & 0x3F, head >> 14, grid.feedback(q, dq, torque), temperature / 10)


def fault_names(bits: int) -> str:
    """Faults of feedback in words, comma-separated."""
    return ", ".join(name for place, name in enumerate(FAULTS) if bits >> place & 1)
