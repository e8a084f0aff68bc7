"""The gate: limits checked last, just before a command becomes a frame. Pure and scalar: one joint, one cycle.

What it does with what it gets:

- torque beyond the limit or changing faster than the rate: limited;
- target position outside the window or moving faster than the limit: limited (a joint that stands outside the window
  is led back into it at the velocity limit, never further out);
- a number that is not finite where the mode needs it, an unknown mode, a command or reading that is too old: refused.
  The joint goes to quick stop in this very cycle, and the link raises.

A joint under torque control follows its measured position with the target position, and a joint under position control
its produced torque with the target torque, so that a change of mode starts from what is: zero would drop the load.
"""

import math
from typing import NamedTuple

from armlink.cia402 import Mode

OFF, POSITION, TORQUE = int(Mode.OFF), int(Mode.POSITION), int(Mode.TORQUE)
MODES = (OFF, POSITION, TORQUE)


class JointLimits(NamedTuple):
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


class Passed(NamedTuple):
    """What leaves the gate for one joint; torque and position are also what the next cycle starts from."""

    torque: float
    """Target torque before quantisation [N·m]."""
    position: float
    """Target position before quantisation [rad]."""
    torque_wire: int
    """6071h, per mille of the rated torque, rounded towards zero."""
    position_wire: int
    """607Ah, user units, rounded into the window."""
    refused: bool
    """The command was refused: the joint must be stopped."""
    mode: int
    """Mode that was commanded."""


def pass_gate(
    limits: JointLimits,
    mode: int,
    torque: float,
    position: float,
    held: Passed,
    produced_torque: float,
    measured_position: float,
    fresh: bool,
) -> Passed:
    """Limit one joint's command (torque [N·m], position [rad]).

    `held` is what passed in the cycle before; `produced_torque` (6077h) and `measured_position` are the newest
    readings, NaN where there is none; `fresh` says that neither the command nor the reading is too old.
    """
    needed = torque if mode == TORQUE else position if mode == POSITION else 0.0
    refused = not (fresh and mode in MODES and math.isfinite(needed))
    start_torque, start_position = held.torque, held.position
    if held.mode != TORQUE and math.isfinite(produced_torque):
        start_torque = produced_torque
    if held.mode != POSITION and math.isfinite(measured_position):
        start_position = measured_position
    if refused:
        next_torque, next_position = start_torque, start_position
    elif mode == TORQUE:
        next_torque = _towards(start_torque, torque, limits.torque_step)
        next_position = measured_position if math.isfinite(measured_position) else start_position
    elif mode == POSITION:
        next_torque = produced_torque if math.isfinite(produced_torque) else start_torque
        goal = _within(position, limits.lower, limits.upper)
        next_position = _towards(start_position, goal, limits.position_step)
    else:
        next_torque, next_position = 0.0, start_position
    return _passed(limits, next_torque, next_position, refused, mode)


def start_from(limits: JointLimits, produced_torque: float, measured_position: float) -> Passed:
    """What the first cycle starts from: the torque now produced [N·m] and the position now measured [rad]."""
    return _passed(limits, produced_torque if math.isfinite(produced_torque) else 0.0, measured_position, False, OFF)


def is_fresh(age: float, limit: float) -> bool:
    """Whether an age is between zero and a limit [s]; false for NaN."""
    return 0.0 <= age <= limit


def _passed(limits: JointLimits, torque: float, position: float, refused: bool, mode: int) -> Passed:
    """Quantise; rounding never leads out of the torque limit, nor out of the window from within."""
    torque = _within(torque, -limits.max_torque, limits.max_torque)
    wire = round(position / limits.position_unit)
    if limits.lower <= position <= limits.upper:
        lowest = math.ceil(limits.lower / limits.position_unit)
        wire = _within_whole(wire, lowest, math.floor(limits.upper / limits.position_unit))
    return Passed(torque, position, int(torque / limits.torque_unit), wire, refused, mode)


def _towards(start: float, goal: float, step: float) -> float:
    return goal if abs(goal - start) <= step else start + math.copysign(step, goal - start)


def _within(value: float, lower: float, upper: float) -> float:
    return lower if value < lower else upper if value > upper else value


def _within_whole(value: int, lower: int, upper: int) -> int:
    return lower if value < lower else upper if value > upper else value
