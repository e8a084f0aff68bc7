"""Frames of ODrive's CANSimple (firmware 0.6): 11-bit identifier node << 5 | command, little endian.

Source: ODrive's CAN protocol page and its published message file (0.6.10). Positions are the motor's revolutions,
torques the motor's N·m.
"""

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

from armlink.drives.orders import name_flags


class Message(IntEnum):
    """Command number: low five bits of the identifier."""

    VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    ERROR = 0x03
    AXIS_STATE = 0x07
    ESTIMATES = 0x09
    CONTROLLER_MODE = 0x0B
    INPUT_POSITION = 0x0C
    INPUT_VELOCITY = 0x0D
    INPUT_TORQUE = 0x0E
    LIMITS = 0x0F
    CURRENT = 0x14
    TEMPERATURE = 0x15
    BUS = 0x17
    CLEAR_ERRORS = 0x18
    POSITION_GAIN = 0x1A
    VELOCITY_GAINS = 0x1B
    TORQUES = 0x1C


class AxisState(IntEnum):
    UNDEFINED = 0
    IDLE = 1
    CLOSED_LOOP = 8
    ANTICOGGING = 14  # the last of all


TORQUE_CONTROL, VELOCITY_CONTROL, POSITION_CONTROL, PASSTHROUGH = 1, 2, 3, 1
"""Control modes, and the input mode that takes inputs as they are."""
INPUT_FEED_FORWARD = 0.001
"""Step of velocity [rev/s] and torque [N·m] feed-forward in an input position."""


class AxisError(IntFlag):
    INITIALIZING = 1 << 0
    SYSTEM_LEVEL = 1 << 1
    TIMING = 1 << 2
    MISSING_ESTIMATE = 1 << 3
    BAD_CONFIG = 1 << 4
    DRIVER_FAULT = 1 << 5
    MISSING_INPUT = 1 << 6
    BUS_OVERVOLTAGE = 1 << 8
    BUS_UNDERVOLTAGE = 1 << 9
    BUS_OVERCURRENT = 1 << 10
    BUS_OVERREGENERATION = 1 << 11
    CURRENT_LIMIT = 1 << 12
    MOTOR_HOT = 1 << 13
    STAGE_HOT = 1 << 14
    VELOCITY_LIMIT = 1 << 15
    POSITION_LIMIT = 1 << 16
    WATCHDOG = 1 << 24
    ESTOP = 1 << 25
    SPINOUT = 1 << 26
    BRAKE_RESISTOR = 1 << 27
    THERMISTOR = 1 << 28
    CALIBRATION = 1 << 30


class Heartbeat(NamedTuple):
    """Cyclic heartbeat; `error` can be 0 although the axis was disarmed, so its state counts."""

    error: int
    state: int
    result: int = 0
    done: int = 0


LAYOUTS = {
    Message.VERSION: "<8B",
    Message.HEARTBEAT: "<IBBBx",
    Message.ERROR: "<II",
    Message.AXIS_STATE: "<I",
    Message.ESTIMATES: "<ff",
    Message.CONTROLLER_MODE: "<II",
    Message.INPUT_POSITION: "<fhh",
    Message.INPUT_VELOCITY: "<ff",
    Message.INPUT_TORQUE: "<f",
    Message.LIMITS: "<ff",
    Message.CURRENT: "<ff",
    Message.TEMPERATURE: "<ff",
    Message.BUS: "<ff",
    Message.CLEAR_ERRORS: "<B",
    Message.POSITION_GAIN: "<f",
    Message.VELOCITY_GAINS: "<ff",
    Message.TORQUES: "<ff",
}
LENGTHS = dict.fromkeys((Message.AXIS_STATE, Message.INPUT_TORQUE, Message.POSITION_GAIN), 8)
"""Lengths of messages that the published file pads; the drive, as ODrive's own examples, takes them shorter too."""
STRUCTS = {message: struct.Struct(layout) for message, layout in LAYOUTS.items()}


def identifier(node: int, message: int) -> int:
    """11-bit identifier of a message of axis `node` (0 to 63)."""
    return node << 5 | message


def pack(message: Message, *values: float) -> bytes:
    """Bytes of a message; raises struct.error for values that do not fit."""
    return STRUCTS[message].pack(*values).ljust(LENGTHS.get(message, 0), b"\0")


def unpack(message: int, data: bytes) -> tuple[float, ...] | None:
    """Values of a message, or None if it is not known or too short; what the drive pads with is ignored."""
    layout = STRUCTS.get(message)  # type: ignore[call-overload]
    if layout is None or len(data) < layout.size:
        return None
    values: tuple[float, ...] = layout.unpack_from(data)
    return values


def heartbeat(data: bytes) -> Heartbeat | None:
    """The heartbeat in `data`, or None if it is too short; firmware 0.5.6 sends eight bytes as well."""
    values = unpack(Message.HEARTBEAT, data)
    return None if values is None else Heartbeat(*(int(value) for value in values))


def error_names(bits: int) -> str:
    return name_flags(AxisError, bits) or f"unknown ({bits:#x})"


def input_position(position: float, velocity: float, torque: float) -> bytes:
    """Input position [rev] with feed-forward of velocity [rev/s] and torque [N·m], both in steps of 0.001."""
    return pack(Message.INPUT_POSITION, position, _to_steps(velocity), _to_steps(torque))


def _to_steps(value: float) -> int:
    return max(-0x8000, min(0x7FFF, round(value / INPUT_FEED_FORWARD)))
