"""The gate: limits checked last, just before a command becomes a frame. Pure and scalar: one joint, one cycle.

What it limits, and passes on:

- a torque beyond the limit, or changing faster than the rate, which grows as torque control begins;
- a target position outside the window, or moving faster than the velocity limit (a joint that stands outside the window
  is led back into it at that velocity, never further out).

What it refuses, so that it fails closed: the joint goes to quick stop in this very cycle, and the link stops the others
and raises:

- an unknown mode, a number that is not finite where the mode needs it, a command that is too old or of the future;
- a reading that is too old or missing, a fault of bus, node or drive;
- a joint that turns faster than its limit allows with the margin stated for its mode, by the velocity that its drive
  tells or by what its positions prove, whichever is faster; readings that contradict each other;
- under torque control, where nothing else bounds the motion: a joint that reads a position beyond the window and its
  margin, or whose velocity is not known;
- under position control: a joint that is further from its target than the following error allowed;
- entering torque control where the torque now produced is not known: zero would drop the load; or where the drive tells
  another than its gains and its order come to.

A joint under torque control follows its measured position with the target position, and a joint under position control
its produced torque with the target torque, so that a change of mode starts from what is.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from armlink.drives.orders import Mode, Order, Power

OFF = int(Mode.OFF)
POSITION_MODES = (int(Mode.POSITION), int(Mode.PROFILE_POSITION))
TORQUE_MODES = (int(Mode.TORQUE), int(Mode.PROFILE_TORQUE))
MODES = (OFF, *POSITION_MODES, *TORQUE_MODES)
ON, STOPPED, NO_POWER = Power.ON, Power.STOPPED, Power.OFF

BAD_MODE, BAD_NUMBER, COMMAND_AGE = "mode", "number", "command age"
SAMPLE_AGE, STATE, CONTRADICTION = "sample age", "state", "contradiction"
VELOCITY, WINDOW, ENTRY, FOLLOWING = "velocity", "window", "entry", "following error"
FALSE_TORQUE = "false torque"
TORQUE_LIMIT_SHARE = 0.97
"""Share of max_torque that gains, targets and feed-forward may come to together; the rest is for their rounding."""
ROUNDING_FACTOR, POSITION_ROUNDING = 1 + 1e-6, 1e-6
"""Rounding of a bound in single precision: relative, and absolute for positions [rad]."""
TORQUE_SHARE = 0.15
"""A drive's torque reading may differ so much from what its gains and order come to, as a share of max_torque, ..."""
TORQUE_RATIO = 0.4
"""... and by this share of the greater besides: scales that are off by 10 to 40 % are for `armlink check --scales`."""
EASE_SECONDS = 0.5
"""What a torque does to the joint is not known before it moves: for so long after a joint has come under torque control
the rate of its torque grows from 0 to max_torque_rate, and its speed limit from EASED_SPEED to the whole [s]. A drive
that codes torques 3.4 times too large would else be at 2.8 times max_velocity before its positions tell
(`tests/campaigns/false_readings.py --family six-damiao six-robstride`)."""
EASED_SPEED = 0.72
"""Share of the speed limit at the beginning: a little above max_velocity, so that a joint may be under way."""
RETURN_ROUNDING = 1e-3
"""Rounding of a target outside the window, on its way back [rad]."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of one joint; no frame exceeds them."""

    max_torque: float
    """[N·m]."""
    torque_step: float
    """Most that the target torque changes in one cycle [N·m]."""
    position_step: float
    """Most that the target position moves in one cycle [rad]."""
    lower: float
    """Lower end of the target window [rad]."""
    upper: float
    """Upper end of the target window [rad]."""
    overspeed: float
    """A joint under torque control that turns faster is refused [rad/s]."""
    servo_overspeed: float
    """A joint under position control that turns faster is refused [rad/s]."""
    following: float
    """A joint under position control that reads a position further from its target is refused [rad]."""
    outside: float
    """A joint under torque control that reads a position further outside the window is refused [rad]."""
    max_age: float
    """Oldest command and oldest reading that count [s]."""
    period: float = 0.0
    """Of the cycle [s]."""
    kp: float = 0.0
    """Gain of a drive that has no integral term of its own [N·m/rad]; 0: it has a position controller of its own."""
    kd: float = 0.0
    """[N·m·s/rad]."""
    most_sent: float = 0.0
    """Most that the bytes of a frame may say, where the host's calibration makes it more than max_torque [N·m]."""

    def __post_init__(self) -> None:
        """Without a calibration in the host the bytes say what the joint is to make."""
        object.__setattr__(self, "most_sent", max(self.most_sent, self.max_torque))


class Seen(NamedTuple):
    """State of one joint when its command is about to leave; NaN if a reading is missing or too old."""

    torque: float
    """Torque now produced [N·m]."""
    position: float
    """[rad]."""
    velocity: float
    """[rad/s]."""
    age: float
    """Time since the position came [s]."""
    healthy: bool
    """Neither the bus nor a node nor a drive has a fault."""


class Corroboration(NamedTuple):
    """Bounds on a reading by a joint's other readings and its order: none is believed alone."""

    proven: float = 0.0
    """Speed that its positions prove [rad/s]; 0 where they prove none."""
    ahead: float = 0.0
    """Speed that they prove for when an order acts, if the joint goes on as it does [rad/s]; likewise."""
    contradicted: bool = False
    """Its position and velocity readings cannot both be right."""
    ordered_torque: float = math.nan
    """Torque that its newest order comes to by the drive's gains [N·m]; NaN where the drive's law is not known."""
    eased: float = 1.0
    """Share of EASE_SECONDS that it has been under torque control, at most 1."""


NOTHING_KNOWN = Corroboration()


def pass_gate(
    limits: JointLimits,
    mode: int,
    torque: float,
    position: float,
    age: float,
    held: Order,
    seen: Seen,
    others: Corroboration = NOTHING_KNOWN,
) -> Order:
    """Limit one joint's command (torque [N·m], position [rad]), decided `age` seconds ago.

    `held` is what passed in the cycle before, `seen` what is known of the joint now, `others` what speaks for it or
    against it. Under position control of a drive without an integral term `torque` is the feed-forward.
    """
    refused = _refusal(limits, mode, torque, position, age, held, seen, others)
    start_torque, start_position = held.torque, held.position
    if held.mode not in TORQUE_MODES and math.isfinite(seen.torque):
        start_torque = others.ordered_torque if math.isfinite(others.ordered_torque) else seen.torque
    if held.mode not in POSITION_MODES and math.isfinite(seen.position):
        start_position = seen.position
    if refused:
        return _passed(limits, start_torque, start_position, OFF, STOPPED, refused)
    if mode in TORQUE_MODES:
        step = limits.torque_step * others.eased
        return _passed(limits, _towards(start_torque, torque, step), seen.position, mode, ON)
    if mode in POSITION_MODES:
        goal = _towards(start_position, _within(position, limits.lower, limits.upper), limits.position_step)
        if limits.kp:
            return _leashed(limits, mode, torque, goal, start_position, seen)
        return _passed(limits, seen.torque if math.isfinite(seen.torque) else start_torque, goal, mode, ON)
    return _passed(limits, 0.0, start_position, mode, NO_POWER)


def _leashed(limits: JointLimits, mode: int, torque: float, goal: float, start: float, seen: Seen) -> Order:
    """An order with gains whose torque kp (q* − q) + kd (v* − v) + τ is within the limit, as the joint is seen now."""
    kp, kd, most = limits.kp, limits.kd, limits.max_torque * TORQUE_LIMIT_SHARE
    stretch = most / kp
    position = _within(goal, seen.position - stretch, seen.position + stretch)
    velocity = (position - start) / limits.period if position == goal and limits.period else 0.0
    moving = kd * (velocity - (seen.velocity if math.isfinite(seen.velocity) else 0.0))
    if abs(moving) > most:  # a joint that is thrown about: damping alone, as much as the limit allows
        speed = abs(seen.velocity) if math.isfinite(seen.velocity) else 0.0
        velocity, kd = 0.0, min(kd, most / speed) if speed else kd
        moving = -kd * seen.velocity if speed else 0.0
    pull = kp * (position - seen.position) + moving
    torque = _within(pull + torque, -most, most) - pull
    return Order(ON, False, mode, position, velocity, torque, kp, kd)


def hold_order(limits: JointLimits, torque: float, position: float, seen: Seen) -> Order:
    """An order to hold a position that was passed before, `torque` being the torque that is produced [N·m]."""
    if limits.kp and math.isfinite(seen.position):
        return _leashed(limits, int(Mode.POSITION), torque, position, position, seen)
    return _passed(limits, torque if math.isfinite(torque) else 0.0, position, int(Mode.POSITION), ON)


def start_order(limits: JointLimits, produced_torque: float, measured_position: float) -> Order:
    """Start of the first cycle: the torque now produced [N·m], 0 if unknown, and the position [rad]."""
    torque = produced_torque if math.isfinite(produced_torque) else 0.0
    return _passed(limits, torque, measured_position, OFF, NO_POWER)


def is_fresh(age: float, limit: float) -> bool:
    """Whether an age is between zero and a limit [s]; false for NaN."""
    return 0.0 <= age <= limit


def _refusal(
    limits: JointLimits,
    mode: int,
    torque: float,
    position: float,
    age: float,
    held: Order,
    seen: Seen,
    others: Corroboration,
) -> str:
    """Why a command is not passed on, or an empty text."""
    if mode not in MODES:
        return BAD_MODE
    if not math.isfinite(torque if mode in TORQUE_MODES else position if mode in POSITION_MODES else 0.0):
        return BAD_NUMBER
    if not is_fresh(age, limits.max_age):
        return COMMAND_AGE
    if not (is_fresh(seen.age, limits.max_age) and math.isfinite(seen.position)):
        return SAMPLE_AGE
    if not seen.healthy:
        return STATE
    if mode == OFF:
        return ""
    if mode in POSITION_MODES:
        return _servo_refusal(limits, held, seen, others)
    fastest = speed_limit(limits, others)
    if not abs(seen.velocity) <= fastest or others.ahead > fastest:
        return VELOCITY
    if others.contradicted:
        return CONTRADICTION
    if not limits.lower - limits.outside <= seen.position <= limits.upper + limits.outside:
        return WINDOW
    if held.mode not in TORQUE_MODES:
        if not math.isfinite(seen.torque):
            return ENTRY
        if _is_false_torque(limits, seen.torque, others.ordered_torque):
            return FALSE_TORQUE
    return ""


def speed_limit(limits: JointLimits, others: Corroboration) -> float:
    """Speed at which a joint under torque control is refused [rad/s]."""
    return limits.overspeed * (EASED_SPEED + (1 - EASED_SPEED) * others.eased)


def _is_false_torque(limits: JointLimits, told: float, ordered: float) -> bool:
    """Whether a drive cannot make the torque that it tells, by its order and gains; false where those are unknown."""
    explained = TORQUE_SHARE * limits.max_torque + TORQUE_RATIO * max(abs(ordered), abs(told))
    return abs(told - ordered) > explained


def _servo_refusal(limits: JointLimits, held: Order, seen: Seen, others: Corroboration) -> str:
    """Why a joint under position control must be stopped; a velocity that is not known is no reason."""
    if abs(seen.velocity) > limits.servo_overspeed or others.proven > limits.servo_overspeed:
        return VELOCITY
    if others.contradicted:
        return CONTRADICTION
    if held.mode in POSITION_MODES and not abs(held.position - seen.position) <= limits.following:
        return FOLLOWING
    return ""


def _passed(limits: JointLimits, torque: float, position: float, mode: int, power: Power, refused: str = "") -> Order:
    """An order for a drive with a position controller of its own."""
    torque = _within(torque, -limits.max_torque, limits.max_torque)
    return Order(power, False, mode, position, 0.0, torque, 0.0, 0.0, refused)


def describe_excess(limits: JointLimits, passed: Order, sent: Order, seen: Seen) -> str:
    """The value of an order, by its bytes, that is beyond a limit, in words; empty if none. The last check of all.

    `passed` is the order that the bytes stand for: outside the window a target may lie only where the gate led it.
    """
    power, _, mode, position, rate, torque, kp, kd, _ = sent
    if power is not ON:
        return ""
    most = limits.most_sent * ROUNDING_FACTOR
    if mode in TORQUE_MODES:
        return "" if abs(torque) <= most else f"torque {torque:.6g} N·m"
    if mode not in POSITION_MODES:
        return ""
    goal, lower, upper = passed.position, limits.lower, limits.upper
    room = (POSITION_ROUNDING if lower <= goal <= upper else RETURN_ROUNDING) + (ROUNDING_FACTOR - 1) * abs(position)
    if not (goal if goal < lower else lower) - room <= position <= (goal if goal > upper else upper) + room:
        return f"position {position:.6g} rad"
    if not (kp or kd):
        return "" if not abs(torque) > most else f"torque {torque:.6g} N·m"
    velocity = seen.velocity if math.isfinite(seen.velocity) else 0.0
    total = kp * (position - seen.position) + kd * (rate - velocity) + torque  # NaN where any of them is: refused
    return "" if abs(total) <= most else f"{total:.6g} N·m (by its gains and targets)"


def _towards(start: float, goal: float, step: float) -> float:
    return _within(goal, start - step, start + step)


def _within(value: float, lower: float, upper: float) -> float:
    return value if lower <= value <= upper else max(lower, min(upper, value))
