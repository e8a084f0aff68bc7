"""Frames of AgileX Piper arms: one controller sends for all six joints by its own clock, big endian.

Sources: `protocol_v2` and `msg_v2` of piper_sdk 0.6.2; agilexrobotics/piper_sdk#73 for torques that firmware up to
S-V1.8-2 scales by four at joints 1 to 3; agilexrobotics/piper_sdk#57 for the range of torques. Of other hosts' frames
the targets of single joints are decoded, not those of the hand.
"""

import math
import re
import struct
from collections.abc import Iterator
from enum import IntFlag

from armlink.drives.mit_packing import Grid, MitCommand, PackedField, Ranges
from armlink.drives.orders import name_flags

JOINTS = range(1, 7)
STOP_ID, MODE_ID, TARGETS_ID, MIT_ID, ENABLE_ID, FIRMWARE_ID = 0x150, 0x151, 0x155, 0x15A, 0x471, 0x4AF
"""Frames of a host; three have the targets of two joints each, six those of one in the MIT law, from here on."""
HAND_IDS = (0x152, 0x153, 0x154, 0x158, 0x159)
STATUS_ID, POSITIONS_ID, MOTION_ID, STATE_ID = 0x2A1, 0x2A5, 0x250, 0x260
"""Frames of the arm: of all joints; of two joints each, from here on; with the joint's number, of one."""
ANGLE = math.radians(0.001)
"""Step of a position [rad]."""
MILLI = 0.001
"""Step of a speed [rad/s] and of a current [A]."""
TORQUE_CONSTANTS = (1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844)
"""Of the joints, as the SDK has them [N·m/A]."""
AMPLIFIED, AMPLIFIED_UNTIL = 4.0, (1, 8, 2)
"""Joints 1 to 3 make so many times the torque of an MIT command and a quarter of what their current tells, up to this
firmware."""
MIT_POSITION, MIT_VELOCITY = PackedField(-12.5, 12.5, 16), PackedField(-45.0, 45.0, 12)
MIT_KP, MIT_KD, MIT_TORQUE = PackedField(0.0, 500.0, 12), PackedField(-5.0, 5.0, 12), PackedField(-8.0, 8.0, 8)
"""Fields of an MIT command [rad], [rad/s], [N·m/rad], [N·m·s/rad], [N·m]; the zero of kd lies between two steps."""
MIT_BITS = (16, 12, 12, 11, 8)
"""Bits of a command's fields, in the order of a grid; the twelfth bit of kd is its sign."""
LEAST_KD = 1 << 11
"""Steps of the smallest kd that does not push [12 bits]."""
MOST_SPEED, MOST_CURRENT = 0x7FFF * MILLI, 0x7FFF * MILLI
"""Ends of the readings [rad/s] and [A]."""
BY_CAN, MOVE_M, MIT = 1, 4, 0xAD
"""Mode of control, way of moving, and its mark, by which joints follow MIT commands."""
ENABLE, DISABLE = 2, 1
FIRMWARE = r"S-V\d+\.\d+-\d+"
"""Pattern of a firmware, such as S-V1.8-2."""


class PiperState(IntFlag):
    """Bits of a joint's state."""

    LOW_VOLTAGE = 1 << 0
    MOTOR_HOT = 1 << 1
    OVERCURRENT = 1 << 2
    STAGE_HOT = 1 << 3
    COLLISION = 1 << 4
    DRIVE_ERROR = 1 << 5
    ENABLED = 1 << 6
    STALL = 1 << 7


ARM_FAULTS = {
    1: "emergency stop",
    5: "no communication with a joint",
    6: "the brake of a joint is closed",
    7: "collision",
    8: "overspeed in hand guiding",
    9: "a joint has a fault",
    14: "controller too hot",
    15: "brake resistor too hot",
}
"""States of the arm that are faults."""

_PAIR, _MOTION, _STATE = struct.Struct(">ii"), struct.Struct(">hhi"), struct.Struct(">HhbBH")


class PiperGrid(Grid):
    """The values that an MIT command can have, its torque as a joint makes it, and no kd that pushes."""

    __slots__ = ()

    def __init__(self, amplification: float) -> None:
        ranges = Ranges(MIT_POSITION.largest, MIT_VELOCITY.largest, amplification * MIT_TORQUE.largest)
        super().__init__(ranges, MIT_BITS)
        self.kd = PackedField(MIT_KD.value(LEAST_KD), MIT_KD.largest, MIT_BITS[3])


def amplification(joint: int, firmware: str) -> float:
    """By which a joint of an arm with this firmware makes more torque than an MIT command says."""
    number = tuple(map(int, re.findall(r"\d+", firmware)))
    return AMPLIFIED if joint <= 3 and number <= AMPLIFIED_UNTIL else 1.0


def unpack_positions(data: bytes) -> tuple[float, float]:
    """Of two joints [rad]; also targets."""
    one, other = _PAIR.unpack(data)
    return one * ANGLE, other * ANGLE


def unpack_motion(data: bytes) -> tuple[float, float]:
    """Speed [rad/s], current [A]."""
    speed, current, _ = _MOTION.unpack(data)
    return speed * MILLI, current * MILLI


def unpack_state(data: bytes) -> tuple[float, int]:
    """Temperature of the motor [°C], bits of PiperState."""
    _, _, temperature, state, _ = _STATE.unpack(data)
    return float(temperature), int(state)


def checksum(data: bytes) -> int:
    """Four bits over the first seven bytes of an MIT command, which end its eighth."""
    result = 0
    for byte in data[:7]:
        result ^= byte
    return result & 0xF


def pack_mit(q: int, dq: int, kp: int, kd: int, torque: int) -> bytes:
    """An MIT command from the steps of a PiperGrid."""
    bits = q << 48 | dq << 36 | kp << 24 | (kd + LEAST_KD) << 12 | torque << 4
    return (bits | checksum(bits.to_bytes(8, "big"))).to_bytes(8, "big")


def unpack_mit(data: bytes) -> MitCommand | None:
    """An MIT command of eight bytes, its torque as it is said; None with a wrong checksum."""
    bits = int.from_bytes(data, "big")
    if bits & 0xF != checksum(data):
        return None
    return MitCommand(
        MIT_POSITION.value(bits >> 48),
        MIT_VELOCITY.value(bits >> 36 & 0xFFF),
        MIT_KP.value(bits >> 24 & 0xFFF),
        max(MIT_KD.value(bits >> 12 & 0xFFF), 0.0),
        MIT_TORQUE.value(bits >> 4 & 0xFF),
    )


def mit_mode() -> bytes:
    """The command to all joints to follow MIT commands from CAN."""
    return bytes([BY_CAN, MOVE_M, 100, MIT, 0, 0, 0, 0])


def switch(joint: int, to: int) -> bytes:
    """The command to a joint to take or to leave power, `to` ENABLE or DISABLE."""
    return bytes([joint, to, 0, 0, 0, 0, 0, 0])


def firmware_request() -> bytes:
    return bytes([1]) + bytes(7)


def firmware_in(pieces: Iterator[bytes]) -> str:
    """The firmware in the text that the arm answers with; empty if it is not in it."""
    found = re.search(FIRMWARE.encode(), b"".join(pieces))
    return found[0].decode() if found else ""


def fault_text(state: int) -> str:
    """Faults in a joint's state, in words; empty: none."""
    bits = state & ~PiperState.ENABLED
    return f"{name_flags(PiperState, bits)} (state {state:02X}h)" if bits else ""
