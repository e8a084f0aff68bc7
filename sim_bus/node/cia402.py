"""State machine of a CiA 402 drive, as a table."""

from enum import IntEnum


class State(IntEnum):
    """States of the power drive system (CiA 402-2, figure of the state machine)."""

    NOT_READY = 0
    SWITCH_ON_DISABLED = 1
    READY = 2
    SWITCHED_ON = 3
    ENABLED = 4
    QUICK_STOP = 5
    FAULT_REACTION = 6
    FAULT = 7


class Command(IntEnum):
    """Commands of the control word."""

    NONE = 0
    DISABLE_VOLTAGE = 1
    QUICK_STOP = 2
    SHUTDOWN = 3
    SWITCH_ON = 4
    ENABLE = 5
    FAULT_RESET = 6


STATUS = {
    State.NOT_READY: 0x00,
    State.SWITCH_ON_DISABLED: 0x40,
    State.READY: 0x21,
    State.SWITCHED_ON: 0x23,
    State.ENABLED: 0x27,
    State.QUICK_STOP: 0x07,
    State.FAULT_REACTION: 0x0F,
    State.FAULT: 0x08,
}
"""State bits of the status word (6041h)."""

TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY,
    (State.READY, Command.SWITCH_ON): State.SWITCHED_ON,
    (State.READY, Command.ENABLE): State.ENABLED,
    (State.READY, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.READY, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.ENABLE): State.ENABLED,
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY,
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,
    (State.ENABLED, Command.SHUTDOWN): State.READY,
    (State.ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Command.QUICK_STOP): State.QUICK_STOP,
    (State.QUICK_STOP, Command.ENABLE): State.ENABLED,
    (State.QUICK_STOP, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.FAULT, Command.FAULT_RESET): State.SWITCH_ON_DISABLED,
}
"""Transitions 2 to 12, 15 and 16; READY to ENABLED combines 3 and 4. Other commands have no effect."""


def command(word: int, previous: int) -> Command:
    """Command of a control word (6040h), given the previous one: fault reset is a rising edge of bit 7."""
    if word & 0x80:
        return Command.NONE if previous & 0x80 else Command.FAULT_RESET
    if not word & 0x02:
        return Command.DISABLE_VOLTAGE
    if not word & 0x04:
        return Command.QUICK_STOP
    if not word & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE if word & 0x08 else Command.SWITCH_ON


def next_state(state: State, asked: Command) -> State:
    """The state that follows `state`."""
    return TRANSITIONS.get((state, asked), state)
