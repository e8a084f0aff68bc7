"""The CiA 402 power state machine as a pure table: status word → state; state and target → next control word."""

import math
from enum import Enum, IntEnum

from armlink.drives.orders import MODE_NAMES as MODE_NAMES
from armlink.drives.orders import Limits, Mode


class DriveState(Enum):
    """States of the power drive system (CiA 402, 6041h)."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"


class Control(IntEnum):
    """Commands of the control word (6040h)."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE = 0x0F
    FAULT_RESET = 0x80


CYCLIC_VELOCITY = 9
"""Cyclic synchronous velocity. No mode of an order: where a device has no position mode, the host makes the velocity
that leads to an ordered position."""
NEEDED_MODES = (Mode.POSITION, Mode.TORQUE)
"""Modes that every controller must support; the profile modes are optional."""
NEW_SET_POINT, CHANGE_AT_ONCE = 0x10, 0x20
"""Bits 4 and 5 of the control word in profile position mode."""
SET_POINT_ACKNOWLEDGED = 0x1000
"""Bit 12 of the status word in profile position mode."""


FASTEST_LOOP, LOOP_PERIODS = 20.0, 0.08
"""Gain of that position loop [1/s]: at most the first, and the second over the period, so that a delay of two or three
periods leaves it well damped; a choice."""


def loop_gain(period: float) -> float:
    """Velocity for one radian off the target [1/s], by the period of the cycle [s]."""
    return min(FASTEST_LOOP, LOOP_PERIODS / period)


def velocity_towards(target: float, before: float, seen: float, limits: Limits) -> float:
    """Velocity [rad/s] that leads a joint to its target, `before` having been that of the last cycle [rad].

    At most `limits.max_velocity`, none towards the outside of the window from outside it, and slowing down towards its
    ends; 0 where nobody knows where the joint is.
    """
    if not math.isfinite(seen):
        return 0.0
    gain = loop_gain(limits.period)
    wanted = (target - before) / limits.period + gain * (target - seen)
    most = min(limits.max_velocity, max(0.0, gain * (limits.upper - seen)))
    least = max(-limits.max_velocity, min(0.0, gain * (limits.lower - seen)))
    return max(least, min(most, wanted))


def supports(supported: int, mode: int) -> bool:
    """Whether 6502h (`supported`) contains a mode of operation: bit mode − 1; mode 0 is always supported."""
    return mode == Mode.OFF or (1 <= mode <= 32 and bool(supported >> (mode - 1) & 1))


_BY_4F = {
    0x00: DriveState.NOT_READY,
    0x40: DriveState.SWITCH_ON_DISABLED,
    0x0F: DriveState.FAULT_REACTION,
    0x08: DriveState.FAULT,
}
_BY_6F = {0x21: DriveState.READY, 0x23: DriveState.SWITCHED_ON, 0x27: DriveState.ENABLED, 0x07: DriveState.QUICK_STOP}

# One step towards ENABLED from each state. Quick stop to enabled is transition 16: power stays on.
_TO_ENABLED = {
    DriveState.SWITCH_ON_DISABLED: Control.SHUTDOWN,
    DriveState.READY: Control.SWITCH_ON,
    DriveState.SWITCHED_ON: Control.ENABLE,
    DriveState.ENABLED: Control.ENABLE,
    DriveState.QUICK_STOP: Control.ENABLE,
}


def state_of(status_word: int) -> DriveState:
    """State that a status word (6041h) encodes; UNKNOWN if the standard does not define the pattern."""
    return _BY_4F.get(status_word & 0x4F) or _BY_6F.get(status_word & 0x6F, DriveState.UNKNOWN)


def next_control(state: DriveState, target: DriveState) -> int:
    """Control word for the next step from `state` towards `target` (ENABLED, QUICK_STOP or SWITCH_ON_DISABLED).

    If the drive moves on by itself (not ready, fault reaction) or the state is unknown, the word is disable voltage,
    which is also the low level that the rising edge of fault reset needs.
    """
    if target is DriveState.QUICK_STOP:
        return int(Control.QUICK_STOP)
    if state is DriveState.FAULT:
        return int(Control.FAULT_RESET)
    step = _TO_ENABLED.get(state) if target is DriveState.ENABLED else None
    return int(step or Control.DISABLE_VOLTAGE)


def set_point_control(status_word: int) -> int:
    """Control word of an enabled drive in profile position mode, so that it takes its newest target immediately.

    Handshake of CiA 402: new set-point (bit 4) rises, the drive acknowledges (status bit 12), bit 4 falls, the drive
    clears the acknowledgement, and so on.
    """
    acknowledged = status_word & SET_POINT_ACKNOWLEDGED
    return Control.ENABLE | CHANGE_AT_ONCE | (0 if acknowledged else NEW_SET_POINT)
