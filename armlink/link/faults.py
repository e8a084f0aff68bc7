"""Faults that the link itself finds, in words: silence, refused commands, irregular traffic. Pure."""

import math
from collections.abc import Sequence

from armlink.drives.orders import MODE_NAMES, Order
from armlink.errors import Silence
from armlink.link import gate
from armlink.link.bus_watchdog import BusWatch
from armlink.link.gate import Corroboration, JointLimits, Seen
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
            f"; others fill the bus meanwhile with {watch.crowding:.0f} frames a cycle, most of them "
            f"{_culprit(names, watch)}: a node babbles: disconnect it"
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
            return f"the command is {age * 1e3:.0f} ms old, expected 0 to {limit.max_age * 1e3:.0f} ms"
        if why == gate.BAD_MODE:
            return f"{name}: mode {command.mode[joint]}, expected {_MODES}"
        if why == gate.BAD_NUMBER and command.mode[joint] in gate.TORQUE_MODES:
            return f"{name}: target torque is {command.torque[joint]}, expected a finite number"
        if why == gate.BAD_NUMBER:
            return f"{name}: target position is {command.position[joint]}, expected a finite number"
        if why == gate.VELOCITY and math.isnan(now.velocity):
            return f"{name}: no velocity has come lately, and torque control needs it"
        if why == gate.CONTRADICTION:
            return (
                f"{name}: its positions and its velocity ({now.velocity:.3g} rad/s) contradict each other: one of them "
                "is false: a scale that is off (docs/safety.md, Scales), a second node, or its encoder"
            )
        if why == gate.FALSE_TORQUE:
            return (
                f"{name}: reports a torque of {now.torque:.3g} N·m, but its gains and its command give "
                f"{other.ordered_torque:.3g}: torque control would start from a false value (docs/safety.md, Scales)"
            )
        if why == gate.VELOCITY and command.mode[joint] in gate.POSITION_MODES:
            return (
                f"{name}: turns at {_speed(now, other):.3g} rad/s under position control, limit "
                f"{limit.servo_overspeed:.3g} (max_velocity and its margin){_by_positions(now, other)}: something else "
                "moves it, or its servo is unstable"
            )
        if why == gate.FOLLOWING:
            return (
                f"{name}: reads {now.position:.4g} rad, more than {limit.following:g} rad from its target "
                f"{passed[joint].position:.4g}: it is blocked or too weak, something else moves it, or its reading is "
                "false"
            )
        if why == gate.VELOCITY:
            return (
                f"{name}: turns at {_speed(now, other):.3g} rad/s under torque control, limit "
                f"{gate.speed_limit(limit, other):.3g} (max_velocity and its margin){_by_positions(now, other)}: "
                "command less torque, or raise max_velocity"
            )
        if why == gate.WINDOW:
            lower, upper = limit.lower - limit.outside, limit.upper + limit.outside
            return (
                f"{name}: reads {now.position:.4g} rad under torque control, expected {lower:.4g} to {upper:.4g}: "
                "its stop or its position sensor is not where the arm file has it"
            )
        if why == gate.ENTRY:
            return f"{name}: the torque now produced is not known, and torque control would start from zero"
    return None


def _speed(seen: Seen, other: Corroboration) -> float:
    """The speed that a joint is refused for [rad/s]: the drive's, with its sign, or what its positions prove."""
    return max(other.proven, other.ahead) if _by_positions(seen, other) else seen.velocity


def _by_positions(seen: Seen, other: Corroboration) -> str:
    """That its positions prove more speed than its drive tells, in words; empty where they do not."""
    if max(other.proven, other.ahead) > abs(seen.velocity):
        return f", by its positions where its velocity reads {seen.velocity:.3g}"
    return ""


def bus_fault(names: Sequence[str], watch: BusWatch, dropped: int) -> str | None:
    """Faults of the bus itself: no reception, a second host, a duplicated id, a babbling node, lost frames; or None."""
    if watch.reception:
        return watch.reception
    if watch.intruder:
        return f"another host is on this bus: it sends {watch.intruder}: stop it, only one program may command an arm"
    doubled = watch.doubled
    if doubled is not None:
        return f"{names[doubled]}: two readings in every cycle: a second node has its id: give every node its own"
    if watch.babbling:
        return (
            f"more frames than these joints send, most of them {_culprit(names, watch)}: a node babbles: disconnect it"
        )
    if watch.forged is not None:
        return (
            f"{names[watch.forged]}: more readings than it sends: a second node sends torques, velocities "
            "or states in its name: give every node its own id, and find out who sends"
        )
    if dropped:
        return f"{dropped} frames lost: this host reads too slowly: give it more time or less to do"
    return None


def _culprit(names: Sequence[str], watch: BusWatch) -> str:
    """The sender of most frames, in words."""
    most = watch.culprit
    return f"readings of {names[most]}" if isinstance(most, int) else most
