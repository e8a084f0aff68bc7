"""The CiA 402 table against the standard's own bit patterns, exhaustively."""

import pytest

from armlink.cia402 import Control, State, next_control, state_of

# CiA 402, table of the status word: bits 6, 5, 3..0 as the standard prints them (x: does not matter).
PATTERNS = {
    State.NOT_READY: "x0xx 0000",
    State.SWITCH_ON_DISABLED: "x1xx 0000",
    State.READY: "x01x 0001",
    State.SWITCHED_ON: "x01x 0011",
    State.ENABLED: "x01x 0111",
    State.QUICK_STOP: "x00x 0111",
    State.FAULT_REACTION: "x0xx 1111",
    State.FAULT: "x0xx 1000",
}

# The drive's transitions (CiA 402 figure of the state machine): what each command does in each state.
TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Control.SHUTDOWN): State.READY,
    (State.READY, Control.SWITCH_ON): State.SWITCHED_ON,
    (State.READY, Control.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.READY, Control.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Control.ENABLE): State.ENABLED,
    (State.SWITCHED_ON, Control.SHUTDOWN): State.READY,
    (State.SWITCHED_ON, Control.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Control.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Control.SWITCH_ON): State.SWITCHED_ON,
    (State.ENABLED, Control.SHUTDOWN): State.READY,
    (State.ENABLED, Control.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Control.QUICK_STOP): State.QUICK_STOP,
    (State.QUICK_STOP, Control.ENABLE): State.ENABLED,
    (State.QUICK_STOP, Control.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.FAULT, Control.FAULT_RESET): State.SWITCH_ON_DISABLED,
}
BY_ITSELF = {State.NOT_READY: State.SWITCH_ON_DISABLED, State.FAULT_REACTION: State.FAULT}


def matches(pattern, word):
    bits = pattern.replace(" ", "")
    return all(bit == "x" or int(bit) == word >> (7 - place) & 1 for place, bit in enumerate(bits))


def test_every_status_word_means_what_the_standard_says():
    for word in range(1 << 16):
        by_standard = [state for state, pattern in PATTERNS.items() if matches(pattern, word)]
        assert len(by_standard) <= 1
        assert state_of(word) is (by_standard[0] if by_standard else State.UNKNOWN)


@pytest.mark.parametrize("target", [State.ENABLED, State.SWITCH_ON_DISABLED, State.QUICK_STOP])
@pytest.mark.parametrize("start", [state for state in State if state is not State.UNKNOWN])
def test_the_table_leads_from_every_state_to_its_target(start, target):
    state = start
    for _ in range(6):
        if state is target:
            break
        word = next_control(state, target)
        assert word in list(Control)
        state = BY_ITSELF.get(state) or TRANSITIONS.get((state, Control(word)), state)
    expected = target
    if target is State.QUICK_STOP and start is not State.ENABLED:
        # only an enabled drive can go to quick stop; the others have no power, or lose it
        expected = state if state in (State.SWITCH_ON_DISABLED, State.FAULT, State.QUICK_STOP) else None
    assert state is expected


@pytest.mark.parametrize("target", [State.ENABLED, State.SWITCH_ON_DISABLED, State.QUICK_STOP])
def test_only_a_fault_gets_a_fault_reset_and_only_a_drive_without_power_a_step_up(target):
    for state in State:
        word = next_control(state, target)
        assert (word == Control.FAULT_RESET) == (state is State.FAULT and target is not State.QUICK_STOP)
        if target is not State.ENABLED:
            assert word not in (Control.SHUTDOWN, Control.SWITCH_ON, Control.ENABLE)


def test_an_unknown_state_is_commanded_nothing():
    assert next_control(State.UNKNOWN, State.ENABLED) == Control.DISABLE_VOLTAGE


def test_there_is_no_way_to_other_targets():
    with pytest.raises(ValueError, match="no way to fault"):
        next_control(State.READY, State.FAULT)
