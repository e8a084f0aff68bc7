"""State machine of a CiA 402 drive, as a table."""

from armlink.drives.canopen.cia402 import Control, DriveState

STATUS = {
    DriveState.NOT_READY: 0x00,
    DriveState.SWITCH_ON_DISABLED: 0x40,
    DriveState.READY: 0x21,
    DriveState.SWITCHED_ON: 0x23,
    DriveState.ENABLED: 0x27,
    DriveState.QUICK_STOP: 0x07,
    DriveState.FAULT_REACTION: 0x0F,
    DriveState.FAULT: 0x08,
}
"""State bits of the status word (6041h)."""

TRANSITIONS = {
    (DriveState.SWITCH_ON_DISABLED, Control.SHUTDOWN): DriveState.READY,
    (DriveState.READY, Control.SWITCH_ON): DriveState.SWITCHED_ON,
    (DriveState.READY, Control.ENABLE): DriveState.ENABLED,
    (DriveState.READY, Control.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
    (DriveState.READY, Control.QUICK_STOP): DriveState.SWITCH_ON_DISABLED,
    (DriveState.SWITCHED_ON, Control.ENABLE): DriveState.ENABLED,
    (DriveState.SWITCHED_ON, Control.SHUTDOWN): DriveState.READY,
    (DriveState.SWITCHED_ON, Control.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
    (DriveState.SWITCHED_ON, Control.QUICK_STOP): DriveState.SWITCH_ON_DISABLED,
    (DriveState.ENABLED, Control.SWITCH_ON): DriveState.SWITCHED_ON,
    (DriveState.ENABLED, Control.SHUTDOWN): DriveState.READY,
    (DriveState.ENABLED, Control.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
    (DriveState.ENABLED, Control.QUICK_STOP): DriveState.QUICK_STOP,
    (DriveState.QUICK_STOP, Control.ENABLE): DriveState.ENABLED,
    (DriveState.QUICK_STOP, Control.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
    (DriveState.FAULT, Control.FAULT_RESET): DriveState.SWITCH_ON_DISABLED,
}
"""Transitions 2 to 12, 15 and 16; READY to ENABLED combines 3 and 4. Other commands have no effect."""


def command(word: int, previous: int) -> Control | None:
    """Command of a control word (6040h), given the previous one: fault reset is a rising edge of bit 7; None: none."""
    if word & 0x80:
        return None if previous & 0x80 else Control.FAULT_RESET
    if not word & 0x02:
        return Control.DISABLE_VOLTAGE
    if not word & 0x04:
        return Control.QUICK_STOP
    if not word & 0x01:
        return Control.SHUTDOWN
    return Control.ENABLE if word & 0x08 else Control.SWITCH_ON


def next_state(state: DriveState, asked: Control | None) -> DriveState:
    return state if asked is None else TRANSITIONS.get((state, asked), state)
