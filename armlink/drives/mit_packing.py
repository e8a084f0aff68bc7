"""Bit packing of the MIT command and its reply, as Damiao, RobStride (MIT mode) and CubeMars drives share it.

Command, eight bytes, big endian: q 16 | dq 12 | kp 12 | kd 12 | τ 12 bits. The drive's law is
`torque = kp·(q* − q) + kd·(dq* − dq) + τ`; nothing in the drive bounds the sum but its own saturation.
Each field is an unsigned number of steps from the lower end of its range; the ranges are the drive's registers.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from armlink.drives.orders import Limits

DAMPING_SHARE = 0.9
"""Damping takes at most this share of the torque limit; the rest is for rounding."""


SOFTER, SOFTER_STEPS = 0.8, 30
"""Factor by which both gains are lowered, again and again, while the sum of the law is beyond the limit."""


class Ranges(NamedTuple):
    """Ends of the packed ranges: ±position [rad], ±velocity [rad/s], ±torque [N·m], 0 to kp and 0 to kd."""

    position: float
    velocity: float
    torque: float
    kp: float = 500.0
    """[N·m/rad]."""
    kd: float = 5.0
    """[N·m·s/rad]."""

    @property
    def torque_quantum(self) -> float:
        """Step of a packed torque [N·m]; zero lies half a step from its neighbours."""
        return 2 * self.torque / 0xFFF

    @property
    def position_quantum(self) -> float:
        """Step of a packed position [rad]."""
        return 2 * self.position / 0xFFFF


class MitCommand(NamedTuple):
    """One MIT command in SI units."""

    position: float
    velocity: float
    kp: float
    kd: float
    torque: float


class MitFeedback(NamedTuple):
    """Position [rad], velocity [rad/s] and torque [N·m] of a reply."""

    position: float
    velocity: float
    torque: float


def to_steps(value: float, lowest: float, highest: float, bits: int) -> int:
    """Nearest step of `value` between `lowest` (0) and `highest` (all ones); beyond the range its end.

    Raises ValueError for a number that is not finite.
    """
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be packed: expected a finite number")
    most = (1 << bits) - 1
    return max(0, min(most, round((value - lowest) / (highest - lowest) * most)))


def from_steps(steps: int, lowest: float, highest: float, bits: int) -> float:
    """Value of a packed number of steps."""
    return lowest + steps * (highest - lowest) / ((1 << bits) - 1)


def pack_command(command: MitCommand, ranges: Ranges) -> bytes:
    """The eight bytes of a command. Raises ValueError for numbers that are not finite."""
    q = to_steps(command.position, -ranges.position, ranges.position, 16)
    dq = to_steps(command.velocity, -ranges.velocity, ranges.velocity, 12)
    kp = to_steps(command.kp, 0.0, ranges.kp, 12)
    kd = to_steps(command.kd, 0.0, ranges.kd, 12)
    torque = to_steps(command.torque, -ranges.torque, ranges.torque, 12)
    return (q << 48 | dq << 36 | kp << 24 | kd << 12 | torque).to_bytes(8, "big")


def unpack_command(data: bytes, ranges: Ranges) -> MitCommand:
    """A command as the drive understands it; `data` has eight bytes."""
    bits = int.from_bytes(data[:8], "big")
    return MitCommand(
        from_steps(bits >> 48, -ranges.position, ranges.position, 16),
        from_steps(bits >> 36 & 0xFFF, -ranges.velocity, ranges.velocity, 12),
        from_steps(bits >> 24 & 0xFFF, 0.0, ranges.kp, 12),
        from_steps(bits >> 12 & 0xFFF, 0.0, ranges.kd, 12),
        from_steps(bits & 0xFFF, -ranges.torque, ranges.torque, 12),
    )


def pack_feedback(feedback: MitFeedback, ranges: Ranges) -> bytes:
    """Bytes 1 to 5 of a reply: q 16 | dq 12 | τ 12 bits."""
    q = to_steps(feedback.position, -ranges.position, ranges.position, 16)
    dq = to_steps(feedback.velocity, -ranges.velocity, ranges.velocity, 12)
    torque = to_steps(feedback.torque, -ranges.torque, ranges.torque, 12)
    return (q << 24 | dq << 12 | torque).to_bytes(5, "big")


def unpack_feedback(data: bytes, ranges: Ranges) -> MitFeedback:
    """Feedback from bytes 1 to 5 of a reply (`data` has at least five bytes)."""
    bits = int.from_bytes(data[:5], "big")
    return MitFeedback(
        from_steps(bits >> 24, -ranges.position, ranges.position, 16),
        from_steps(bits >> 12 & 0xFFF, -ranges.velocity, ranges.velocity, 12),
        from_steps(bits & 0xFFF, -ranges.torque, ranges.torque, 12),
    )


def unwrap(position: float, near: float, span: float) -> float:
    """The position that differs from the packed one by whole `span`s and is nearest to `near` [rad]."""
    return position + span * round((near - position) / span)


def round_within(
    command: MitCommand,
    coded: Callable[[MitCommand], MitCommand],
    ranges: Ranges,
    torque_quantum: float,
    limits: Limits,
    position: float,
    velocity: float,
) -> MitCommand:
    """The command, moved by as few steps as it takes to stay within `limits` after rounding.

    `coded` gives a command as its bytes tell it. `position` and `velocity` are the newest readings (NaN if there are
    none), by which the sum of the law is bounded; the torque alone and the target position are bounded in any case.

    Raises ValueError for numbers that are not finite.
    """
    if not all(math.isfinite(value) for value in command):
        raise ValueError(f"{command} cannot be packed: expected finite numbers")
    most = limits.max_torque
    torque = max(-most, min(most, command.torque))
    command = command._replace(torque=torque)
    told = coded(command)
    if told.kp > 0 and limits.lower <= command.position <= limits.upper:
        command = command._replace(position=_inwards(told.position, limits, ranges.position_quantum))
        told = coded(command)
    total = _law(told, position, velocity) if math.isfinite(position + velocity) else told.torque
    beyond = max(total - most, told.torque - most, 0.0) or min(total + most, told.torque + most, 0.0)
    if beyond:
        steps = math.copysign(math.ceil(abs(beyond) / torque_quantum), beyond)
        lowest = told.torque - steps * torque_quantum
        command = command._replace(torque=max(-most, min(most, lowest)))
        told = coded(command)
        if abs(told.torque) > most:  # the limit lies between two steps
            command = command._replace(torque=told.torque - math.copysign(torque_quantum, told.torque))
    if not math.isfinite(position + velocity):
        return command
    for _ in range(SOFTER_STEPS):  # where the torque, limited by itself, cannot keep the sum within the limit
        if abs(_law(coded(command), position, velocity)) <= most:
            return command
        command = command._replace(kp=SOFTER * command.kp, kd=SOFTER * command.kd)
    return command._replace(kp=0.0, kd=0.0)


def _law(told: MitCommand, position: float, velocity: float) -> float:
    """Torque that a drive makes of a command where it stands [N·m]."""
    return told.kp * (told.position - position) + told.kd * (told.velocity - velocity) + told.torque


def damping(kd: float, position: float, velocity: float, most: float) -> MitCommand:
    """A command that damps with at most `kd`, and with no more torque than `most` [N·m] at the present velocity."""
    if abs(velocity) * kd > DAMPING_SHARE * most:
        kd = DAMPING_SHARE * most / abs(velocity)
    return MitCommand(position if math.isfinite(position) else 0.0, 0.0, 0.0, kd, 0.0)


def _inwards(position: float, limits: Limits, quantum: float) -> float:
    """A coded position, a step back where rounding led out of the window."""
    if position > limits.upper:
        return position - quantum
    return position + quantum if position < limits.lower else position
