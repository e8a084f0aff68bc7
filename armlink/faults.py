"""Faults that a cycle shows, in words: which joint, what, and what to do. Pure."""

import math
from collections.abc import Mapping, Sequence

from armlink import emcy, objects
from armlink.cia402 import Mode, State, state_of
from armlink.gate import MODES, is_fresh
from armlink.sample import Command, Sample

ENABLED_BITS = 0x27
_FAULTS = (State.FAULT, State.FAULT_REACTION)


def find_fault(
    names: Sequence[str],
    sample: Sample,
    modes: Sequence[int],
    emergencies: Sequence[tuple[int, int, int]],
    node_states: Mapping[int, int],
    max_age: float,
) -> str | None:
    """The first fault of a cycle in which every joint with a mode was to be enabled, or None.

    `emergencies` are (joint, code, error register), `node_states` NMT states by joint, `max_age` [s].
    """
    for joint, code, register in emergencies:
        if code:
            meaning = emcy.name_of(code)
            return f"{names[joint]}: emergency {code:04X}h, {meaning} (error register {register:02X}h)"
    for joint, state in node_states.items():
        if state == 0:
            return f"{names[joint]}: its controller has restarted (boot-up message): calibration and mode are lost"
        if state != objects.OPERATIONAL:
            return f"{names[joint]}: NMT state is {objects.NMT_STATES.get(state, state)}, expected operational"
    for joint, age in enumerate(sample.age.tolist()):
        if age > max_age:
            return f"{names[joint]}: no reading for {age * 1e3:.0f} ms, limit {max_age * 1e3:.0f} ms"
    for joint, status in enumerate(sample.status.tolist()):
        if status & 0x6F == ENABLED_BITS:
            continue
        state_402 = state_of(status)
        if modes[joint] != Mode.OFF or state_402 in _FAULTS:
            return f"{names[joint]}: {state_402.value} (status word {status:#06x}), expected operation enabled"
    return None


def refusal(names: Sequence[str], command: Command, command_age: float, max_age: float) -> str | None:
    """Why the gate refused a command, in one line; None where the command was not the reason. Ages in [s]."""
    if not is_fresh(command_age, max_age):
        return f"the command is {command_age * 1e3:.0f} ms old, expected 0 to {max_age * 1e3:.0f} ms"
    for name, mode, torque, position in zip(names, command.mode, command.torque, command.position, strict=True):
        if mode not in MODES:
            return f"{name}: mode {mode}, expected 0 (off), 8 (position) or 10 (torque)"
        if mode == Mode.TORQUE and not math.isfinite(torque):
            return f"{name}: target torque is {torque}, expected a finite number"
        if mode == Mode.POSITION and not math.isfinite(position):
            return f"{name}: target position is {position}, expected a finite number"
    return None


def stuck(
    names: Sequence[str],
    states: Sequence[State],
    target: State,
    emergencies: Sequence[tuple[int, int, int]],
    seconds: float,
) -> str:
    """Why the joints did not all reach `target` within `seconds`: the first that did not, and its emergency if any."""
    for joint, code, _ in emergencies:
        if code and states[joint] is not target:
            return f"{names[joint]}: {states[joint].value} after emergency {code:04X}h, {emcy.name_of(code)}"
    for name, state in zip(names, states, strict=True):
        if state is not target:
            return f"{name}: stays in {state.value}, expected {target.value} within {seconds} s"
    return f"no complete set of readings within {seconds} s of cycles: frames are lost"
