"""State machine of a CiA 402 drive, as a table."""

from enum import IntEnum


class PowerState(IntEnum):
    """States of the power drive system (CiA 402-2, figure of the state machine)."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY = 2
    SWITCHED_ON = 3
    ENABLED = 4
    QUICK_STOP = 5
    FAULT_REACTION = 6
    FAULT = 7


class ControlCommand(IntEnum):
    NONE = 0
    DISABLE_VOLTAGE = 1
    QUICK_STOP = 2
    SHUTDOWN = 3
    SWITCH_ON = 4
    ENABLE = 5
    FAULT_RESET = 6


STATUS = {
    PowerState.NOT_READY: 0x00,
    PowerState.SWITCH_ON_DISABLED: 0x40,
    PowerState.READY: 0x21,
    PowerState.SWITCHED_ON: 0x23,
    PowerState.ENABLED: 0x27,
    PowerState.QUICK_STOP: 0x07,
    PowerState.FAULT_REACTION: 0x0F,
    PowerState.FAULT: 0x08,
}
"""State bits of the status word (6041h)."""

TRANSITIONS = {
    (PowerState.SWITCH_ON_DISABLED, ControlCommand.SHUTDOWN): PowerState.READY,
    (PowerState.READY, ControlCommand.SWITCH_ON): PowerState.SWITCHED_ON,
    (PowerState.READY, ControlCommand.ENABLE): PowerState.ENABLED,
    (PowerState.READY, ControlCommand.DISABLE_VOLTAGE): PowerState.SWITCH_ON_DISABLED,
    (PowerState.READY, ControlCommand.QUICK_STOP): PowerState.SWITCH_ON_DISABLED,
    (PowerState.SWITCHED_ON, ControlCommand.ENABLE): PowerState.ENABLED,
    (PowerState.SWITCHED_ON, ControlCommand.SHUTDOWN): PowerState.READY,
    (PowerState.SWITCHED_ON, ControlCommand.DISABLE_VOLTAGE): PowerState.SWITCH_ON_DISABLED,
    (PowerState.SWITCHED_ON, ControlCommand.QUICK_STOP): PowerState.SWITCH_ON_DISABLED,
    (PowerState.ENABLED, ControlCommand.SWITCH_ON): PowerState.SWITCHED_ON,
    (PowerState.ENABLED, ControlCommand.SHUTDOWN): PowerState.READY,
    (PowerState.ENABLED, ControlCommand.DISABLE_VOLTAGE): PowerState.SWITCH_ON_DISABLED,
    (PowerState.ENABLED, ControlCommand.QUICK_STOP): PowerState.QUICK_STOP,
    (PowerState.QUICK_STOP, ControlCommand.ENABLE): PowerState.ENABLED,
    (PowerState.QUICK_STOP, ControlCommand.DISABLE_VOLTAGE): PowerState.SWITCH_ON_DISABLED,
    (PowerState.FAULT, ControlCommand.FAULT_RESET): PowerState.SWITCH_ON_DISABLED,
}
"""Transitions 2 to 12, 15 and 16; READY to ENABLED combines 3 and 4. Other commands have no effect."""


def command(word: int, previous: int) -> ControlCommand:
    """Command of a control word (6040h), given the previous one: fault reset is a rising edge of bit 7."""
    if word & 0x80:
        return ControlCommand.NONE if previous & 0x80 else ControlCommand.FAULT_RESET
    if not word & 0x02:
        return ControlCommand.DISABLE_VOLTAGE
    if not word & 0x04:
        return ControlCommand.QUICK_STOP
    if not word & 0x01:
        return ControlCommand.SHUTDOWN
    return ControlCommand.ENABLE if word & 0x08 else ControlCommand.SWITCH_ON


def next_state(state: PowerState, asked: ControlCommand) -> PowerState:
    return TRANSITIONS.get((state, asked), state)
