"""Faults that the frames of CiA 402 drives show, in words: which joint, what, and what to do. Pure."""

import math
from collections import deque
from collections.abc import Sequence

from armlink.drives.board import EVENTS_KEPT, NO_STATUS
from armlink.drives.canopen import emcy
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import CYCLIC_VELOCITY, MODE_NAMES, DriveState, state_of
from armlink.drives.orders import Mode
from armlink.errors import BusFault, Stall

OFF = int(Mode.OFF)
ENABLED_BITS = 0x27
WATCHDOGS = frozenset({0x8130, 0x8250, 0x8700})
"""Emergencies of a node that does not hear its host: heartbeat, RPDO deadline, SYNC (CiA 301)."""
_FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION)


class JointStates:
    def __init__(self, names: Sequence[str]) -> None:
        m = len(names)
        self.names = names
        self.statuses = [NO_STATUS] * m
        """Status words (6041h)."""
        self.displays = [OFF] * m
        self.mode_since = [-math.inf] * m
        """When each joint's mode was commanded, by the clock [s]."""
        self.positions = [math.nan] * m
        """Position readings [rad]."""
        self.emergencies: deque[tuple[int, int, int]] = deque(maxlen=EVENTS_KEPT)
        """(joint, code, error register) in the order of arrival; ends of errors (code 0) are not kept."""
        self.node_states: dict[int, int] = {}
        """NMT states by joint, of the newest heartbeat."""
        self.restarted: set[int] = set()
        """Joints whose controller has sent its boot-up message."""


def alarm(known: JointStates) -> BusFault | None:
    """The first event: emergency, restart, NMT state; a Stall where a joint did not hear its host."""
    for joint, code, register in known.emergencies:
        fault = Stall if code in WATCHDOGS else BusFault
        return fault(
            f"{known.names[joint]}: emergency {code:04X}h, {emcy.name_of(code)} (error register {register:02X}h)"
        )
    for joint in sorted(known.restarted):
        return BusFault(
            f"{known.names[joint]}: its drive has restarted (boot-up message): calibration and mode are lost; "
            "find out why, then start again"
        )
    for joint, state in known.node_states.items():
        if state != objects.OPERATIONAL:
            found = objects.NMT_STATES.get(state, str(state))
            return BusFault(f"{known.names[joint]}: its NMT state is {found}, expected operational")
    return None


def state_fault(known: JointStates, now: float, modes: Sequence[int], patience: float) -> BusFault | None:
    """The first fault by status words and mode displays, if every joint with a mode was to be enabled in it.

    A mode must be displayed within `patience` [s].
    """
    for joint, (mode, status, display) in enumerate(zip(modes, known.statuses, known.displays, strict=True)):
        if mode != OFF and display != mode and not now - known.mode_since[joint] <= patience:
            return BusFault(f"{known.names[joint]}: {refused_mode(mode, display)}")
        if status & 0x6F == ENABLED_BITS:
            continue
        state = state_of(status)
        if mode != OFF or state in _FAULTS:
            told = f'state "{state.value}" (status word {status:#06x}), expected "operation enabled"'
            return BusFault(f"{known.names[joint]}: {told}: read its error code 603Fh")
    return None


def stopped_itself(known: JointStates, joint: int) -> str:
    """That a joint's own watch of the host has stopped it, as it must, in words; empty if it has not."""
    codes = [code for place, code, _ in known.emergencies if place == joint]
    watched = [code for code in codes if code in WATCHDOGS]
    if not watched and (codes or state_of(known.statuses[joint]) is not DriveState.QUICK_STOP):
        return ""
    why = f" (emergency {watched[0]:04X}h, {emcy.name_of(watched[0])})" if watched else ""
    return f"{known.names[joint]} stopped itself{why}"


def refused_mode(mode: int, display: int) -> str:
    """That a controller does not enter a mode that it was told to."""
    name = "cyclic synchronous velocity" if mode == CYCLIC_VELOCITY else MODE_NAMES[Mode(mode)]
    return (
        f"refuses mode {mode} ({name}): its mode display 6061h is {display}; read its error code "
        "603Fh and its supported modes 6502h"
    )


def stuck(known: JointStates, joint: int, target: DriveState, mode: int, seconds: float) -> str:
    """Why a joint did not reach `target` in its `mode` within `seconds`."""
    name, state = known.names[joint], state_of(known.statuses[joint])
    if state is target:
        return f"{name}: {refused_mode(mode, known.displays[joint])}"
    for place, code, _ in known.emergencies:
        if place == joint:
            return f'{name}: is in state "{state.value}" after emergency {code:04X}h, {emcy.name_of(code)}'
    return f'{name}: stays in state "{state.value}" and does not reach "{target.value}" within {seconds} s'
