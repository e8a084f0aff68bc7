"""The CiA 402 table against the standard's own bit patterns, exhaustively."""

import itertools

import pytest

from armlink.drives.canopen.cia402 import (
    MODE_NAMES,
    NEEDED_MODES,
    Control,
    DriveState,
    Mode,
    next_control,
    set_point_control,
    state_of,
    supports,
)
from sim_bus.node import cia402 as simulated

# CiA 402, table of the status word: bits 6, 5, 3..0 as the standard prints them (x: does not matter).
PATTERNS = {
    DriveState.NOT_READY: "x0xx 0000",
    DriveState.SWITCH_ON_DISABLED: "x1xx 0000",
    DriveState.READY: "x01x 0001",
    DriveState.SWITCHED_ON: "x01x 0011",
    DriveState.ENABLED: "x01x 0111",
    DriveState.QUICK_STOP: "x00x 0111",
    DriveState.FAULT_REACTION: "x0xx 1111",
    DriveState.FAULT: "x0xx 1000",
}

# The drive's transitions (CiA 402 figure of the state machine): what each command does in each state.
TRANSITIONS = {
    (DriveState.SWITCH_ON_DISABLED, Control.SHUTDOWN): DriveState.READY,
    (DriveState.READY, Control.SWITCH_ON): DriveState.SWITCHED_ON,
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
BY_ITSELF = {DriveState.NOT_READY: DriveState.SWITCH_ON_DISABLED, DriveState.FAULT_REACTION: DriveState.FAULT}


def matches(pattern, word):
    bits = pattern.replace(" ", "")
    return all(bit == "x" or int(bit) == word >> (7 - place) & 1 for place, bit in enumerate(bits))


# By the low byte, which alone tells the state; the other bits of the status word do not matter to the standard.
BY_STANDARD = [[state for state, pattern in PATTERNS.items() if matches(pattern, low)] for low in range(256)]


def test_every_status_word_means_what_the_standard_says():
    assert max(map(len, BY_STANDARD)) == 1
    for word in range(1 << 16):
        by_standard = BY_STANDARD[word & 0xFF]
        assert state_of(word) is (by_standard[0] if by_standard else DriveState.UNKNOWN)


# What the link may command from each state towards each target, written down once more by hand.
WORDS = {
    DriveState.ENABLED: {
        DriveState.SWITCH_ON_DISABLED: 0x06,
        DriveState.READY: 0x07,
        DriveState.SWITCHED_ON: 0x0F,
        DriveState.ENABLED: 0x0F,
        DriveState.QUICK_STOP: 0x0F,
        DriveState.FAULT: 0x80,
    },
    DriveState.SWITCH_ON_DISABLED: {DriveState.FAULT: 0x80},
    DriveState.QUICK_STOP: dict.fromkeys(DriveState, 0x02),
}


@pytest.mark.parametrize("target", WORDS)
def test_every_status_word_leads_to_the_one_command_of_the_table(target):
    for word in range(1 << 16):
        by_standard = BY_STANDARD[word & 0xFF]
        expected = (
            WORDS[target].get(by_standard[0], 0x00) if by_standard else WORDS[target].get(DriveState.UNKNOWN, 0x00)
        )
        assert next_control(state_of(word), target) == expected


def command_of(control):
    """CiA 402, table of the control word: which command bits 7, 3, 2, 1, 0 are."""
    if control & 0x80:
        return Control.FAULT_RESET
    patterns = {"xx0x": 0x00, "x01x": 0x02, "x110": 0x06, "0111": 0x07, "1111": 0x0F}
    for pattern, command in patterns.items():
        if all(bit == "x" or int(bit) == control >> (3 - place) & 1 for place, bit in enumerate(pattern)):
            return Control(command)
    raise AssertionError(control)


def test_every_status_word_and_every_command_keeps_to_the_drives_own_state_machine():
    """Whatever command follows whatever state, the link recognises where the drive then is."""
    bits = {state: int(pattern.replace(" ", "").replace("x", "0"), 2) for state, pattern in PATTERNS.items()}
    for word in range(256):
        state = state_of(word)
        for control in range(256):
            after = BY_ITSELF.get(state) or TRANSITIONS.get((state, command_of(control)), state)
            assert (state is DriveState.UNKNOWN) == (after is DriveState.UNKNOWN)
            if after is not DriveState.UNKNOWN:
                assert state_of(bits[after]) is after


def test_a_simulated_drive_keeps_to_the_standard_in_every_state_and_by_every_control_word():
    """It shares the names of states and commands with the link, and nothing else: its tables are its own."""
    for state, pattern in PATTERNS.items():
        assert matches(pattern, simulated.STATUS[state])
        for word, previous in itertools.product(range(256), (0x00, 0x80)):
            asked = command_of(word)
            after = TRANSITIONS.get((state, asked), state)
            if asked is Control.FAULT_RESET and previous & 0x80:  # it is an edge
                after = state
            if (state, asked) == (DriveState.READY, Control.ENABLE):  # transitions 3 and 4 in one
                after = DriveState.ENABLED
            assert simulated.next_state(state, simulated.command(word, previous)) is after


def test_supported_modes_are_bits_of_6502h():
    assert [mode for mode in Mode if supports(0x0209, mode)] == [0, 1, 4, 10]
    assert [mode for mode in Mode if supports(0x0080, mode)] == [0, 8]
    assert not supports(0xFFFFFFFF, -1)
    assert not supports(0xFFFFFFFF, 33)
    assert supports(0xFFFFFFFF, 32)


def test_a_new_set_point_is_handed_over_by_its_handshake():
    assert set_point_control(0x0027) == 0x3F  # enable, new set-point, change at once
    assert set_point_control(0x1027) == 0x2F  # acknowledged: the bit falls, the target stays


@pytest.mark.parametrize("target", [DriveState.ENABLED, DriveState.SWITCH_ON_DISABLED, DriveState.QUICK_STOP])
@pytest.mark.parametrize("start", [state for state in DriveState if state is not DriveState.UNKNOWN])
def test_the_table_leads_from_every_state_to_its_target(start, target):
    state = start
    for _ in range(6):
        if state is target:
            break
        word = next_control(state, target)
        assert word in list(Control)
        state = BY_ITSELF.get(state) or TRANSITIONS.get((state, Control(word)), state)
    expected = target
    if target is DriveState.QUICK_STOP and start is not DriveState.ENABLED:
        # only an enabled drive can go to quick stop; the others have no power, or lose it
        expected = state if state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT, DriveState.QUICK_STOP) else None
    assert state is expected


@pytest.mark.parametrize("target", [DriveState.ENABLED, DriveState.SWITCH_ON_DISABLED, DriveState.QUICK_STOP])
def test_only_a_fault_gets_a_fault_reset_and_only_a_drive_without_power_a_step_up(target):
    for state in DriveState:
        word = next_control(state, target)
        assert (word == Control.FAULT_RESET) == (state is DriveState.FAULT and target is not DriveState.QUICK_STOP)
        if target is not DriveState.ENABLED:
            assert word not in (Control.SHUTDOWN, Control.SWITCH_ON, Control.ENABLE)


def test_an_unknown_state_is_commanded_nothing():
    assert next_control(DriveState.UNKNOWN, DriveState.ENABLED) == Control.DISABLE_VOLTAGE


def test_states_and_modes_have_the_names_that_users_read():
    assert [state.value for state in DriveState] == [
        "not ready to switch on",
        "switch on disabled",
        "ready to switch on",
        "switched on",
        "operation enabled",
        "quick stop active",
        "fault reaction active",
        "fault",
        "unknown",
    ]
    assert set(MODE_NAMES) == set(Mode)
    assert set(NEEDED_MODES) == {8, 10}
