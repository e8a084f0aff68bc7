"""Faults that a cycle shows, in words: which joint, what, and what to do. Pure."""

from collections.abc import Mapping, Sequence

import numpy as np

from armlink import emcy, objects
from armlink.cia402 import Mode, State, state_of
from armlink.gate import Limits, Passed
from armlink.sample import Command, Sample

_FAULTS = (State.FAULT, State.FAULT_REACTION)


def find_fault(
    names: Sequence[str],
    sample: Sample,
    mode: Sequence[int],
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
    for joint, status in enumerate(sample.status.tolist()):
        state_402 = state_of(status)
        if state_402 is not State.ENABLED and (mode[joint] != Mode.OFF or state_402 in _FAULTS):
            return f"{names[joint]}: {state_402.value} (status word {status:#06x}), expected operation enabled"
    joint = int(np.argmax(sample.age))
    if sample.age[joint] > max_age:
        return f"{names[joint]}: no reading for {sample.age[joint] * 1e3:.0f} ms, limit {max_age * 1e3:.0f} ms"
    return None


def refusal(names: Sequence[str], passed: Passed, command: Command, limits: Limits, command_age: float) -> str:
    """Why the gate refused the first joint's command, in one line."""
    joint = int(np.argmax(passed.refused))
    if not 0 <= command_age <= limits.max_command_age:
        return f"the command is {command_age * 1e3:.0f} ms old, limit {limits.max_command_age * 1e3:.0f} ms"
    mode = int(command.mode[joint])
    if mode == Mode.TORQUE and not np.isfinite(command.torque[joint]):
        return f"{names[joint]}: target torque is {command.torque[joint]}, expected a finite number"
    if mode == Mode.POSITION and not np.isfinite(command.position[joint]):
        return f"{names[joint]}: target position is {command.position[joint]}, expected a finite number"
    if mode not in (Mode.OFF, Mode.POSITION, Mode.TORQUE):
        return f"{names[joint]}: mode {mode}, expected 0 (off), 8 (position) or 10 (torque)"
    return f"{names[joint]}: its newest reading is older than {limits.max_sample_age * 1e3:.0f} ms"
