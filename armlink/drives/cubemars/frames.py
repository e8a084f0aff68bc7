"""Replies and models of CubeMars AK drives in MIT mode; their commands are packed as Damiao's.

A reply has the drive's id, position, velocity and torque; from firmware 1.1 on also a temperature and an error. It
tells neither whether the motor has power nor whether a watchdog ran out. Sources: the maker's driver manual for the AK
series, section 5.3; `mit_can.py` of neurobionics/TMotorCANControl; dfki-ric-underactuated-lab/mini-cheetah-tmotor-
python-can.
"""

from typing import NamedTuple

from armlink.drives.mit_packing import Grid, MitFeedback, pack_feedback, unpack_feedback

MODELS = {
    "AK10-9": (12.5, 50.0, 65.0),
    "AK40-10": (12.5, 45.5, 5.0),
    "AK45-10": (12.5, 20.0, 8.0),
    "AK45-36": (12.5, 6.0, 34.0),
    "AK60-6": (12.5, 45.0, 15.0),
    "AK70-10": (12.5, 50.0, 25.0),
    "AK80-6": (12.5, 76.0, 12.0),
    "AK80-8": (12.5, 37.5, 32.0),
    "AK80-9": (12.5, 50.0, 18.0),
    "AK80-64": (12.5, 8.0, 144.0),
}
"""Ranges of position [rad], velocity [rad/s] and torque [N·m] by the manual. Firmware 1 has others: velocities of an
AK80-9 end at 22.5 there, and at 25.64 in some of firmware 2."""
ERRORS = {
    1: "overtemperature",
    2: "overcurrent",
    3: "overvoltage",
    4: "undervoltage",
    5: "encoder",
    6: "phase currents unbalanced",
}


class CubeMarsReply(NamedTuple):
    """Reply to any frame that a drive gets."""

    drive: int
    feedback: MitFeedback
    temperature: int | None
    """[°C]; None, as the error, in a reply of six bytes."""
    error: int | None


def pack_reply(reply: CubeMarsReply, grid: Grid) -> bytes:
    tail = b"" if reply.temperature is None else bytes([max(0, min(255, reply.temperature)), reply.error or 0])
    return bytes([reply.drive]) + pack_feedback(reply.feedback, grid) + tail


def unpack_reply(data: bytes, grid: Grid) -> CubeMarsReply | None:
    if len(data) not in (6, 8):
        return None
    temperature, error = (data[6], data[7]) if len(data) == 8 else (None, None)
    return CubeMarsReply(data[0], unpack_feedback(data[1:6], grid), temperature, error)


def error_text(error: int | None) -> str:
    """An error in words, with its number; empty: none."""
    return f"{ERRORS.get(error, 'unknown')} (error {error})" if error else ""
