"""Frames of MyActuator RMD-X drives: eight bytes, little endian, the first of which is the command.

Source: the maker's servo motor control protocol for V3 drives, V4.2 of May 2024. What is used here has been the same
since V3.4. Angles are those of the output.
"""

import math
import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

from armlink.drives.orders import name_flags

COMMAND_ID, REPLY_ID = 0x140, 0x240
"""With the drive's id: identifiers of commands to it and of its replies."""
ALL_ID, SET_ID, MOTION_ID = 0x280, 0x300, 0x400
"""Commands to all drives; to set the id of all; in motion mode, with the drive's id."""
LAST_ID = 32
ANGLE = math.radians(0.01)
"""Step of an angle [rad]."""
SPEED = math.radians(1.0)
"""Step of a speed [rad/s]."""
CURRENT = 0.01
"""Step of a current [A]."""
MOST_CURRENT, MOST_ANGLE, MOST_SPEED = 0x7FFF, 0x7FFFFFFF, 0xFFFF
"""Most steps that a command can have."""


class RmdCommand(IntEnum):
    """First byte of a command and of its reply."""

    ACCELERATION = 0x42
    OFF = 0x80
    STOP = 0x81
    ANGLE = 0x92
    ERROR = 0x9A
    STATUS = 0x9C
    TORQUE = 0xA1
    SPEED = 0xA2
    POSITION = 0xA4
    RUNTIME = 0xB1
    VERSION = 0xB2
    TIMEOUT = 0xB3
    MODEL = 0xB5


STATES = frozenset((RmdCommand.STATUS, RmdCommand.TORQUE, RmdCommand.SPEED, RmdCommand.POSITION))
"""Commands whose reply is a state."""


class RmdError(IntFlag):
    MOTOR_STALL = 0x0002
    LOW_VOLTAGE = 0x0004
    OVERVOLTAGE = 0x0008
    OVERCURRENT = 0x0010
    POWER_OVERRUN = 0x0040
    CALIBRATION_NOT_WRITTEN = 0x0080
    OVERSPEED = 0x0100
    OVERTEMPERATURE = 0x1000
    ENCODER_CALIBRATION = 0x2000


class RmdState(NamedTuple):
    """Temperature [°C], current [A] and speed [rad/s]; its angle in whole degrees is left out."""

    temperature: float
    current: float
    speed: float


RATINGS = {
    "X4-3": (1.5, 2.0),
    "X4-24": (9.0, 3.5),
    "X6-7": (3.5, 4.0),
    "X6-8": (4.5, 3.6),
    "X6-40": (18.0, 5.2),
    "X8-20": (10.0, 5.2),
    "X8-25": (10.0, 3.2),
    "X8-60": (30.0, 4.0),
    "X8-90": (25.0, 10.0),
    "X10-40": (15.0, 6.5),
    "X10-100": (50.0, 6.7),
    "X12-150": (50.0, 15.0),
    "X15-400": (130.0, 23.0),
    "X4V2": (1.0, 1.6),
    "X4V3": (1.2, 3.0),
    "X6V2": (3.5, 4.0),
    "X6S2V2": (18.0, 2.6),
    "X6V3": (4.5, 3.6),
    "X8V2": (9.0, 4.3),
    "X8ProV2": (13.0, 5.0),
    "X8S2V3": (25.0, 3.2),
    "X8HV3": (6.0, 3.5),
    "X8ProHV3": (8.0, 3.75),
    "X10V3": (12.0, 5.3),
    "X10S2V3": (50.0, 6.7),
}
"""Rated torque [N·m] at rated current [A], by model, from the maker's data sheets as `actuator_constants.hpp` of
2b-t/myactuator_rmd has them. Their ratio is the torque constant here: the constants that the same sheets print are
those of the motor before the gear for some models, and of the output for others (2b-t/myactuator_rmd#6)."""


def torque_constant(model: str) -> float:
    """At the output [N·m/A]."""
    torque, current = RATINGS[model]
    return torque / current


MOST_TORQUE = max(RATINGS, key=torque_constant)
"""The model with the largest torque constant: any other makes less than is asked of it."""


def model_named(told: str) -> str:
    """The model that a drive tells, which has no hyphen; empty if it is none of RATINGS."""
    return next((model for model in RATINGS if model.replace("-", "").upper()[:7] == told.upper()), "")


_TORQUE, _POSITION, _ANGLE = struct.Struct("<B3xh2x"), struct.Struct("<BxHi"), struct.Struct("<B3xi")
_STATE, _ERROR, _COUNT = struct.Struct("<Bbhhh"), struct.Struct("<BbxBHH"), struct.Struct("<B3xI")


def request(command: RmdCommand) -> bytes:
    """A command without values."""
    return bytes([command, 0, 0, 0, 0, 0, 0, 0])


def pack_torque(steps: int) -> bytes:
    return _TORQUE.pack(RmdCommand.TORQUE, steps)


def unpack_torque(data: bytes) -> int:
    """Steps of current."""
    return int(_TORQUE.unpack(data)[1])


def pack_position(steps: int, most_speed: int) -> bytes:
    """Go to so many steps of angle, with at most so many steps of speed."""
    return _POSITION.pack(RmdCommand.POSITION, most_speed, steps)


def unpack_position(data: bytes) -> tuple[int, int]:
    """Steps of angle, most steps of speed."""
    _, speed, steps = _POSITION.unpack(data)
    return int(steps), int(speed)


def unpack_angle(data: bytes) -> float:
    """Angle of several turns [rad]."""
    return float(_ANGLE.unpack(data)[1] * ANGLE)


def unpack_state(data: bytes) -> RmdState:
    _, temperature, current, speed, _ = _STATE.unpack(data)
    return RmdState(float(temperature), current * CURRENT, speed * SPEED)


def unpack_error(data: bytes) -> tuple[float, int]:
    """Temperature [°C], error bits."""
    _, temperature, _, _, error = _ERROR.unpack(data)
    return float(temperature), int(error)


def unpack_count(data: bytes) -> int:
    """Unsigned number of a reply: time since the start [ms], date of the software, time-out [ms], acceleration."""
    return int(_COUNT.unpack(data)[1])


def unpack_model(data: bytes) -> str:
    return "".join(chr(byte) for byte in data[1:] if 0x20 < byte < 0x7F)


def timeout_command(milliseconds: int) -> bytes:
    """Sets the time-out of communication, which the drive keeps in its flash; armlink never sends it."""
    return _COUNT.pack(RmdCommand.TIMEOUT, milliseconds)


def error_text(error: int) -> str:
    """Errors in words, with their number; empty: none."""
    return f"{name_flags(RmdError, error) or 'unknown'} (error {error:04X}h)" if error else ""
