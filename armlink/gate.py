"""The gate: limits checked last, just before a command becomes a frame. Pure: arrays in, wire values out.

What it does with what it gets, joint by joint:

- torque beyond the limit or changing faster than the rate: limited;
- target position outside the window or moving faster than the limit: limited (a joint that stands outside the
  window is led back into it at the velocity limit, and no further out);
- a number that is not finite where the mode needs it, an unknown mode, a command or sample that is too old: refused.
  The joint goes to quick stop in this very cycle, and the link raises.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armlink.cia402 import Mode

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of n joints, each (n,); no frame exceeds them."""

    max_torque: Array
    """[N·m]."""
    max_torque_rate: Array
    """[N·m/s]."""
    max_velocity: Array
    """Of the target position [rad/s]."""
    lower: Array
    """Lower end of the target window [rad]."""
    upper: Array
    """Upper end of the target window [rad]."""
    torque_unit: Array
    """One per mille of the rated torque [N·m]."""
    position_unit: Array
    """One user unit [rad]."""
    max_command_age: float
    """[s]."""
    max_sample_age: float
    """[s]."""


@dataclass(eq=False)
class Passed:
    """What leaves the gate; torque and position are also what the next cycle starts from."""

    torque: Array
    """Target torque before quantisation [N·m], (n,)."""
    position: Array
    """Target position before quantisation [rad], (n,)."""
    torque_wire: NDArray[np.int64]
    """6071h, per mille of the rated torque, rounded towards zero."""
    position_wire: NDArray[np.int64]
    """607Ah, user units, rounded into the window."""
    refused: NDArray[np.bool_]
    """Joints whose command was refused: they must be stopped."""


def pass_gate(
    limits: Limits,
    period: float,
    mode: NDArray[np.int8],
    torque: Array,
    position: Array,
    held: Passed,
    produced_torque: Array,
    measured_position: Array,
    sample_age: Array,
    command_age: float,
) -> Passed:
    """Limit one command of n joints.

    `held` is what passed last; `produced_torque` (6077h) and `measured_position` are the newest readings (NaN where
    there is none). A joint under torque follows its measured position with the target position, and a joint under
    position control its produced torque with the target torque, so that a change of mode starts from what is.
    """
    on_torque, on_position = mode == Mode.TORQUE, mode == Mode.POSITION
    finite_torque, finite_position = np.isfinite(torque), np.isfinite(position)
    known = on_torque | on_position | (mode == Mode.OFF)
    usable = (finite_torque | ~on_torque) & (finite_position | ~on_position) & known
    fresh = (sample_age <= limits.max_sample_age) & (0.0 <= command_age <= limits.max_command_age)
    refused = ~(usable & fresh)

    follow_torque = np.where(np.isfinite(produced_torque), produced_torque, held.torque)
    follow_position = np.where(np.isfinite(measured_position), measured_position, held.position)
    step = limits.max_torque_rate * period
    wanted = np.where(on_torque & ~refused, torque, held.torque)
    limited = held.torque + np.clip(wanted - held.torque, -step, step)
    next_torque = np.where(on_torque, limited, np.where(on_position, follow_torque, 0.0))
    next_torque = np.clip(next_torque, -limits.max_torque, limits.max_torque)

    stride = limits.max_velocity * period
    aim = np.clip(np.where(on_position & ~refused, position, held.position), limits.lower, limits.upper)
    strode = held.position + np.clip(aim - held.position, -stride, stride)
    next_position = np.where(on_position, strode, follow_position)
    return Passed(next_torque, next_position, *_quantise(limits, next_torque, next_position), refused)


def start_from(limits: Limits, torque: Array, position: Array) -> Passed:
    """What the first cycle starts from: the torque now produced and the position now measured."""
    start = np.clip(np.nan_to_num(torque), -limits.max_torque, limits.max_torque)
    passed = Passed(start, position.copy(), *(np.zeros(start.size, np.int64),) * 2, np.zeros(start.size, bool))
    passed.torque_wire, passed.position_wire = _quantise(limits, start, position)
    return passed


def _quantise(limits: Limits, torque: Array, position: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Wire values; rounding never leads out of a limit, nor further out of the window than the joint already is."""
    torque_wire = np.clip(np.trunc(torque / limits.torque_unit), -32768, 32767)
    lowest = np.ceil(np.minimum(limits.lower, position) / limits.position_unit)
    highest = np.floor(np.maximum(limits.upper, position) / limits.position_unit)
    position_wire = np.clip(np.rint(position / limits.position_unit), lowest, highest)
    return torque_wire.astype(np.int64), np.clip(position_wire, -(2**31), 2**31 - 1).astype(np.int64)
