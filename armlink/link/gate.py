"""The gate: limits checked last, just before a command becomes a frame. Pure and scalar: one joint, one cycle.

What it limits, and passes on:

- a torque beyond the limit, or changing faster than the rate;
- a target position outside the window, or moving faster than the velocity limit (a joint that stands outside the window
  is led back into it at that velocity, never further out).

What it refuses, so that it fails closed: the joint goes to quick stop in this very cycle, and the link stops the others
and raises:

- an unknown mode, a number that is not finite where the mode needs it, a command that is too old or of the future;
- a reading that is too old or missing, a fault of bus, node or drive;
- a joint that turns faster than its limit allows with the margin stated for its mode;
- under torque control, where nothing else bounds the motion: a joint that reads a position beyond the window and its
  margin, or whose velocity is not known;
- under position control: a joint that is further from its target than the following error allowed;
- entering torque control where the torque now produced is not known: zero would drop the load.

A joint under torque control follows its measured position with the target position, and a joint under position control
its produced torque with the target torque, so that a change of mode starts from what is.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from armlink.drives.canopen.cia402 import Mode

OFF = int(Mode.OFF)
POSITION_MODES = (int(Mode.POSITION), int(Mode.PROFILE_POSITION))
TORQUE_MODES = (int(Mode.TORQUE), int(Mode.PROFILE_TORQUE))
MODES = (OFF, *POSITION_MODES, *TORQUE_MODES)
LOWEST_WIRE, HIGHEST_WIRE = -(2**31), 2**31 - 1
"""Range of 607Ah."""

BAD_MODE, BAD_NUMBER, COMMAND_AGE = "mode", "number", "command age"
SAMPLE_AGE, STATE = "sample age", "state"
VELOCITY, WINDOW, ENTRY, FOLLOWING = "velocity", "window", "entry", "following error"


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
    torque_unit: float
    """One per mille of the rated torque [N·m]."""
    position_unit: float
    """One user unit [rad]."""
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
    lowest_wire: int = field(init=False)
    """Least 607Ah within the window, user units."""
    highest_wire: int = field(init=False)
    """Greatest 607Ah within the window, user units."""

    def __post_init__(self) -> None:
        """Work out what does not change from cycle to cycle."""
        object.__setattr__(self, "lowest_wire", math.ceil(self.lower / self.position_unit))
        object.__setattr__(self, "highest_wire", math.floor(self.upper / self.position_unit))


class Seen(NamedTuple):
    """State of one joint when its command is about to leave; NaN if a reading is missing or too old."""

    torque: float
    """Torque now produced, 6077h [N·m]."""
    position: float
    """[rad]."""
    velocity: float
    """606Ch [rad/s]."""
    age: float
    """Time since the position came [s]."""
    healthy: bool
    """Neither the bus nor a node nor a drive has a fault."""


class Passed(NamedTuple):
    """A command that left the gate for one joint; the next cycle starts from its torque and position."""

    torque: float
    """Target torque before quantisation [N·m]."""
    position: float
    """Target position before quantisation [rad]."""
    torque_wire: int
    """6071h, per mille of the rated torque, rounded towards zero."""
    position_wire: int
    """607Ah, user units, rounded into the window."""
    refused: str
    """Why the command was refused, so that the joint must be stopped; empty where it passed."""
    mode: int
    """Mode that was commanded, 0 where that was refused."""


def pass_gate(
    limits: JointLimits, mode: int, torque: float, position: float, age: float, held: Passed, seen: Seen
) -> Passed:
    """Limit one joint's command (torque [N·m], position [rad]), decided `age` seconds ago.

    `held` is what passed in the cycle before, `seen` what is known of the joint now.
    """
    refused = _refusal(limits, mode, torque, position, age, held, seen)
    start_torque, start_position = held.torque, held.position
    if held.mode not in TORQUE_MODES and math.isfinite(seen.torque):
        start_torque = seen.torque
    if held.mode not in POSITION_MODES and math.isfinite(seen.position):
        start_position = seen.position
    if refused:
        return _passed(limits, start_torque, start_position, OFF, refused)
    if mode in TORQUE_MODES:
        return _passed(limits, _towards(start_torque, torque, limits.torque_step), seen.position, mode)
    if mode in POSITION_MODES:
        goal = _within(position, limits.lower, limits.upper)
        produced = seen.torque if math.isfinite(seen.torque) else start_torque
        return _passed(limits, produced, _towards(start_position, goal, limits.position_step), mode)
    return _passed(limits, 0.0, start_position, mode)


def start_from(limits: JointLimits, produced_torque: float, measured_position: float) -> Passed:
    """Start of the first cycle: the torque now produced [N·m], 0 if unknown, and the position [rad]."""
    return _passed(limits, produced_torque if math.isfinite(produced_torque) else 0.0, measured_position, OFF)


def is_fresh(age: float, limit: float) -> bool:
    """Whether an age is between zero and a limit [s]; false for NaN."""
    return 0.0 <= age <= limit


def _refusal(
    limits: JointLimits, mode: int, torque: float, position: float, age: float, held: Passed, seen: Seen
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
    if mode in POSITION_MODES:
        return _servo_refusal(limits, held, seen)
    if mode == OFF:
        return ""
    if not abs(seen.velocity) <= limits.overspeed:
        return VELOCITY
    if not limits.lower - limits.outside <= seen.position <= limits.upper + limits.outside:
        return WINDOW
    if held.mode not in TORQUE_MODES and not math.isfinite(seen.torque):
        return ENTRY
    return ""


def _servo_refusal(limits: JointLimits, held: Passed, seen: Seen) -> str:
    """Why a joint under position control must be stopped; a velocity that is not known is no reason."""
    if abs(seen.velocity) > limits.servo_overspeed:
        return VELOCITY
    if held.mode in POSITION_MODES and not abs(held.position - seen.position) <= limits.following:
        return FOLLOWING
    return ""


def _passed(limits: JointLimits, torque: float, position: float, mode: int, refused: str = "") -> Passed:
    """Quantise; rounding never leads out of the torque limit, nor out of the window from within."""
    torque = _within(torque, -limits.max_torque, limits.max_torque)
    lowest, highest = LOWEST_WIRE, HIGHEST_WIRE
    if limits.lower <= position <= limits.upper:
        lowest, highest = limits.lowest_wire, limits.highest_wire
    position_wire = max(lowest, min(highest, round(position / limits.position_unit)))
    return Passed(torque, position, int(torque / limits.torque_unit), position_wire, refused, mode)


def _towards(start: float, goal: float, step: float) -> float:
    return _within(goal, start - step, start + step)


def _within(value: float, lower: float, upper: float) -> float:
    return value if lower <= value <= upper else max(lower, min(upper, value))
