"""Faults that a cycle shows, in words: which joint, what, and what to do. Pure."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from armlink.drives.canopen import emcy
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.cia402 import MODE_NAMES, Mode, State, state_of
from armlink.errors import BusFault, Silence, Stall
from armlink.link import gate
from armlink.link.bus_watchdog import BusWatch
from armlink.link.gate import OFF, JointLimits, Passed, Seen
from armlink.link.types import Command

ENABLED_BITS = 0x27
WATCHDOGS = frozenset({0x8130, 0x8250, 0x8700})
"""Emergencies of a node that does not hear its host: heartbeat, RPDO deadline, SYNC (CiA 301)."""
_FAULTS = (State.FAULT, State.FAULT_REACTION)
_MODES = ", ".join(f"{int(mode)} ({name})" for mode, name in MODE_NAMES.items())


@dataclass
class Known:
    """State of the bus and of n joints: live views of the loop's buffers."""

    names: Sequence[str]
    statuses: Sequence[int]
    """Newest status words (6041h)."""
    displays: Sequence[int]
    """Newest mode displays (6061h)."""
    seen: Sequence[float]
    """When position and torque came, by the clock [s]."""
    mode_since: Sequence[float]
    """When each joint's mode was commanded, by the clock [s]."""
    emergencies: Collection[tuple[int, int, int]]
    """(joint, code, error register)."""
    node_states: Mapping[int, int]
    """NMT states by joint, of the newest heartbeat."""
    restarted: Collection[int]
    """Joints whose controller has sent its boot-up message."""


def find_fault(known: Known, now: float, modes: Sequence[int], max_age: float) -> BusFault | None:
    """The first fault at time `now` if every joint with a mode was to be enabled in it, or None.

    A mode must be displayed, and a reading must have come, within `max_age` [s].
    """
    if known.emergencies or known.restarted or known.node_states:
        fault = node_fault(known)
        if fault:
            watchdog = bool(known.emergencies) and next(iter(known.emergencies))[1] in WATCHDOGS
            return Stall(fault) if watchdog else BusFault(fault)
    oldest = min(known.seen)
    if not now - oldest <= max_age:
        return _silence(known, now, max_age)
    for joint, (mode, status, display) in enumerate(zip(modes, known.statuses, known.displays, strict=True)):
        if mode != OFF and display != mode and not now - known.mode_since[joint] <= max_age:
            return BusFault(f"{known.names[joint]}: {refused_mode(mode, display)}")
        if status & 0x6F == ENABLED_BITS:
            continue
        state = state_of(status)
        if mode != OFF or state in _FAULTS:
            told = f"{state.value} (status word {status:#06x}), expected operation enabled"
            return BusFault(f"{known.names[joint]}: {told}")
    return None


def _silence(known: Known, now: float, max_age: float) -> Silence:
    """Which joints have sent no reading for longer than `max_age` [s]."""
    silent = [name for name, seen in zip(known.names, known.seen, strict=True) if not now - seen <= max_age]
    who = "no joint" if len(silent) == len(known.names) > 1 else silent[0]
    what = "has sent a reading" if who == "no joint" else "no reading"
    age = now - min(known.seen)
    colon = "" if who == "no joint" else ":"
    return Silence(f"{who}{colon} {what} for {age * 1e3:.0f} ms, limit {max_age * 1e3:.0f} ms")


def is_own_watchdog(known: Known, joint: int) -> bool:
    """Whether a joint stopped by itself, as it must when it does not hear its host."""
    codes = {code for place, code, _ in known.emergencies if place == joint}
    return bool(codes & WATCHDOGS) or (not codes and state_of(known.statuses[joint]) is State.QUICK_STOP)


def stopped_itself(known: Known) -> str:
    """The first joint that its own watch of the host has stopped, in words; empty if there is none."""
    for joint, name in enumerate(known.names):
        if is_own_watchdog(known, joint):
            codes = [code for place, code, _ in known.emergencies if place == joint and code in WATCHDOGS]
            why = f" (emergency {codes[0]:04X}h, {emcy.name_of(codes[0])})" if codes else ""
            return f"{name} stopped itself{why}"
    return ""


def node_fault(known: Known) -> str | None:
    """The first fault of a node, whatever its drive is doing: emergency, restart, NMT state; or None."""
    for joint, code, register in known.emergencies:
        return f"{known.names[joint]}: emergency {code:04X}h, {emcy.name_of(code)} (error register {register:02X}h)"
    for joint in sorted(known.restarted):
        return (
            f"{known.names[joint]}: its controller has restarted (boot-up message): calibration and mode are lost; "
            "find out why, then start again"
        )
    for joint, state in known.node_states.items():
        if state != objects.OPERATIONAL:
            found = objects.NMT_STATES.get(state, str(state))
            return f"{known.names[joint]}: NMT state is {found}, expected operational"
    return None


def refused_mode(mode: int, display: int) -> str:
    """That a controller does not enter a mode that it was told to."""
    return (
        f"refuses mode {mode} ({MODE_NAMES[Mode(mode)]}): its mode display 6061h is {display}; "
        "look at its error code 603Fh and at what 6502h says it supports"
    )


def refusal(
    names: Sequence[str],
    command: Command,
    age: float,
    passed: Sequence[Passed],
    seen: Sequence[Seen],
    limits: Sequence[JointLimits],
) -> str | None:
    """Why the gate refused a command, in one line; None where a fault of the bus or a joint was the reason."""
    for joint, name in enumerate(names):
        why, limit, now = passed[joint].refused, limits[joint], seen[joint]
        if why == gate.COMMAND_AGE:
            return f"the command is {age * 1e3:.0f} ms old, expected 0 to {limit.max_age * 1e3:.0f} ms"
        if why == gate.BAD_MODE:
            return f"{name}: mode {command.mode[joint]}, expected {_MODES}"
        if why == gate.BAD_NUMBER and command.mode[joint] in gate.TORQUE_MODES:
            return f"{name}: target torque is {command.torque[joint]}, expected a finite number"
        if why == gate.BAD_NUMBER:
            return f"{name}: target position is {command.position[joint]}, expected a finite number"
        if why == gate.VELOCITY and math.isnan(now.velocity):
            return f"{name}: no velocity (606Ch, TPDO2) has come of late, and torque control needs to know it"
        if why == gate.VELOCITY and command.mode[joint] in gate.POSITION_MODES:
            return (
                f"{name}: turns at {now.velocity:.3g} rad/s under position control, limit {limit.servo_overspeed:.3g} "
                "(max_velocity and its margin): something else moves it, or its servo is unstable"
            )
        if why == gate.FOLLOWING:
            return (
                f"{name}: reads {now.position:.4g} rad, more than {limit.following:g} rad from its target "
                f"{passed[joint].position:.4g}: it is blocked, too weak, or something else moves it"
            )
        if why == gate.VELOCITY:
            return (
                f"{name}: turns at {now.velocity:.3g} rad/s under torque control, limit {limit.overspeed:.3g} "
                "(max_velocity and its margin): less torque, or a higher max_velocity"
            )
        if why == gate.WINDOW:
            lower, upper = limit.lower - limit.outside, limit.upper + limit.outside
            return (
                f"{name}: reads {now.position:.4g} rad under torque control, expected {lower:.4g} to {upper:.4g}: "
                "its stop or its position sensor is not where the arm file has it"
            )
        if why == gate.ENTRY:
            return f"{name}: the torque now produced (6077h) is not known, and torque control would start from zero"
    return None


def stuck(known: Known, states: Sequence[State], target: State, modes: Sequence[int], seconds: float) -> str:
    """Why the joints did not all reach `target` in their `modes` within `seconds`: the first that did not."""
    for joint, code, _ in known.emergencies:
        if states[joint] is not target:
            return f"{known.names[joint]}: {states[joint].value} after emergency {code:04X}h, {emcy.name_of(code)}"
    for name, state in zip(known.names, states, strict=True):
        if state is not target:
            return f"{name}: stays in {state.value}, expected {target.value} within {seconds} s"
    for name, mode, display in zip(known.names, modes, known.displays, strict=True):
        if mode not in (Mode.OFF, display):
            return f"{name}: {refused_mode(mode, display)}"
    return f"no complete set of readings within {seconds} s of cycles: frames are lost"


def bus_fault(names: Sequence[str], watch: BusWatch, dropped: int) -> str | None:
    """Faults of the bus itself: a second host, a duplicated node id, a babbling node, lost frames; or None."""
    if watch.intruder:
        return f"another host is on this bus: it sends {watch.intruder}: stop it, only one program may command an arm"
    doubled = watch.doubled
    if doubled is not None:
        return f"{names[doubled]}: two readings in every cycle: a second node has its id: give every node its own"
    if watch.babbling:
        return f"more frames than these joints send, the last other one {watch.last}: a node babbles: disconnect it"
    if dropped:
        return f"{dropped} frames lost: this host reads too slowly: give it more time or less to do"
    return None
