"""Faults that the link itself finds, in words: silence, refused commands, irregular traffic. Pure."""

import math
from collections.abc import Sequence

from armlink.drives.orders import MODE_NAMES, Order
from armlink.errors import Silence
from armlink.link import gate
from armlink.link.bus_watchdog import BusWatch
from armlink.link.gate import Corroboration, JointLimits, Seen
from armlink.link.gate_limits import OVERSPEED, SERVO_OVERSPEED, SERVO_SPEED
from armlink.link.types import Command

_MODES = ", ".join(f"{int(mode)} ({name})" for mode, name in MODE_NAMES.items())


def silence(names: Sequence[str], seen: Sequence[float], now: float, max_age: float, watch: BusWatch) -> Silence | None:
    """Which joints have sent no reading for longer than `max_age` [s]; `seen` is when they last did [s].

    `watch` tells of what others sent meanwhile: more frames than the joints should have is no fault of theirs.
    """
    if now - min(seen) <= max_age:
        return None
    silent = [name for name, at in zip(names, seen, strict=True) if not now - at <= max_age]
    who = "no joint" if len(silent) == len(names) > 1 else silent[0]
    what = "has sent a reading" if who == "no joint" else "no reading"
    age = now - min(seen)
    colon = "" if who == "no joint" else ":"
    said = f"{who}{colon} {what} for {age * 1e3:.0f} ms, limit {max_age * 1e3:.0f} ms"
    if watch.crowding > len(names):
        said += (
            f"; meanwhile other nodes fill the bus with {watch.crowding:.0f} frames a cycle, most of them "
            f"{_culprit(names, watch)}: a node babbles, disconnect this node"
        )
    return Silence(said)


def refusal(
    names: Sequence[str],
    command: Command,
    age: float,
    passed: Sequence[Order],
    seen: Sequence[Seen],
    limits: Sequence[JointLimits],
    others: Sequence[Corroboration],
) -> str | None:
    """Why the gate refused a command, in one line; None where a fault of the bus or a joint was the reason."""
    for joint, name in enumerate(names):
        why, limit, now, other = passed[joint].refused, limits[joint], seen[joint], others[joint]
        if why == gate.COMMAND_AGE:
            return (
                f"the command is {age * 1e3:.0f} ms old: it must be 0 to {limit.max_age * 1e3:.0f} ms old when it "
                "reaches the gate"
            )
        if why == gate.BAD_MODE:
            return f"{name}: mode {command.mode[joint]}, expected {_MODES}"
        if why == gate.BAD_NUMBER and command.mode[joint] in gate.TORQUE_MODES:
            return f"{name}: target torque is {command.torque[joint]}, expected a finite number"
        if why == gate.BAD_NUMBER:
            return f"{name}: target position is {command.position[joint]}, expected a finite number"
        if why == gate.VELOCITY and math.isnan(now.velocity):
            return f"{name}: torque control needs the joint's velocity, and none was received lately"
        if why == gate.CONTRADICTION:
            return (
                f"{name}: its positions and its velocity ({now.velocity:.3g} rad/s) contradict each other, so "
                "one of the two is false: check the scales in the arm file (docs/safety.md, Scales), whether a "
                "second node has the same id, and the encoder"
            )
        if why == gate.FALSE_TORQUE:
            return (
                f"{name}: its drive reports a torque of {now.torque:.3g} N·m, but its gains and its command give "
                f"{other.ordered_torque:.3g} N·m: torque control would start from a false value (docs/safety.md, "
                "Scales)"
            )
        if why == gate.VELOCITY and command.mode[joint] in gate.POSITION_MODES:
            return (
                f"{name}: turns at {_speed(now, other):.3g} rad/s under position control, "
                f"the limit is {limit.servo_overspeed:.3g} rad/s ({SERVO_OVERSPEED:g} × max_velocity, at least "
                f"{SERVO_SPEED:g} rad/s){_by_positions(now, other)}: something else moves the joint, or its position "
                "loop is unstable"
            )
        if why == gate.FOLLOWING:
            return (
                f"{name}: reads {now.position:.4g} rad, more than {limit.following:g} rad from its target "
                f"{passed[joint].position:.4g} rad: the joint is blocked or too weak, something else moves it, "
                "or its reading is false"
            )
        if why == gate.VELOCITY:
            return (
                f"{name}: turns at {_speed(now, other):.3g} rad/s under torque control, the limit is "
                f"{gate.speed_limit(limit, other):.3g} rad/s (1 to {OVERSPEED:g} × max_velocity)"
                f"{_by_positions(now, other)}: command less torque, or raise max_velocity"
            )
        if why == gate.WINDOW:
            lower, upper = limit.lower - limit.outside, limit.upper + limit.outside
            return (
                f"{name}: reads {now.position:.4g} rad under torque control, but its range is {lower:.4g} "
                f"to {upper:.4g} rad: one of its stops or its position sensor is not where the arm file says"
            )
        if why == gate.ENTRY:
            return f"{name}: its present torque is not known, so torque control would start from zero"
    return None


def _speed(seen: Seen, other: Corroboration) -> float:
    """The speed that a joint is refused for [rad/s]: the drive's, with its sign, or what its positions prove."""
    return max(other.proven, other.ahead) if _by_positions(seen, other) else seen.velocity


def _by_positions(seen: Seen, other: Corroboration) -> str:
    """That its positions prove more speed than its drive tells, in words; empty where they do not."""
    if max(other.proven, other.ahead) > abs(seen.velocity):
        return f" according to its positions (its drive reports {seen.velocity:.3g} rad/s)"
    return ""


def bus_fault(names: Sequence[str], watch: BusWatch, dropped: int) -> str | None:
    """Faults of the bus itself: no reception, a second host, a duplicated id, a babbling node, lost frames; or None."""
    if watch.reception:
        return watch.reception
    if watch.intruder:
        return watch.intrusion
    doubled = watch.doubled
    if doubled is not None:
        return (
            f"{names[doubled]}: two readings come in every cycle, so a second node has the same id: give every node "
            "its own id"
        )
    if watch.babbling:
        return (
            f"the bus carries more frames than these joints send, most of them {_culprit(names, watch)}: a node "
            "babbles, disconnect this node"
        )
    if watch.forged is not None:
        return (
            f"{names[watch.forged]}: more readings come than this joint sends, so a second node sends torques, "
            "velocities or states with the same id: find the sender, and give every node its own id"
        )
    if dropped:
        return (
            f"{dropped} frames were lost because this host reads too slowly: stop other programs on this host, or "
            "give the job less to do in each cycle"
        )
    return None


def _culprit(names: Sequence[str], watch: BusWatch) -> str:
    most = watch.culprit
    return f"readings of {names[most]}" if isinstance(most, int) else most
