"""Bit packing of the MIT command and its reply, as Damiao, RobStride (MIT mode) and CubeMars drives share it.

Command, eight bytes, big endian: q 16 | dq 12 | kp 12 | kd 12 | τ 12 bits. The drive's law is
`torque = kp·(q* − q) + kd·(dq* − dq) + τ`; nothing in the drive bounds the sum but its own saturation.
Each field is an unsigned number of steps from the lower end of its range; the ranges are the drive's registers.
"""

import math
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

MIT_BITS = (16, 12, 12, 12, 12)
"""Bits of q, dq, kp, kd and τ in an MIT command; other frames of the same fields have others."""


class Special(IntEnum):
    """Last byte of a special command: seven bytes FFh, then this; sent to the drive's command id."""

    CLEAR_ERROR = 0xFB
    """CubeMars has none."""
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE


SPECIALS = frozenset(int(command) for command in Special)


def special(command: Special) -> bytes:
    return bytes([0xFF] * 7 + [command])


def special_of(data: bytes) -> Special | None:
    if len(data) == 8 and data[:7] == b"\xff" * 7 and data[7] in SPECIALS:
        return Special(data[7])
    return None


class Ranges(NamedTuple):
    """Ends of the packed ranges: ±position [rad], ±velocity [rad/s], ±torque [N·m], 0 to kp and 0 to kd."""

    position: float
    velocity: float
    torque: float
    kp: float = 500.0
    """[N·m/rad]."""
    kd: float = 5.0
    """[N·m·s/rad]."""


class MitCommand(NamedTuple):
    position: float
    velocity: float
    kp: float
    kd: float
    torque: float


NO_COMMAND = MitCommand(0.0, 0.0, 0.0, 0.0, 0.0)


class MitFeedback(NamedTuple):
    """Position [rad], velocity [rad/s] and torque [N·m] of a reply."""

    position: float
    velocity: float
    torque: float


class PackedField:
    """One packed number: of b bits, 2^b − 1 steps from its lowest to its highest value."""

    __slots__ = ("largest", "least", "most", "span")

    def __init__(self, least: float, largest: float, bits: int) -> None:
        self.least, self.largest, self.span, self.most = least, largest, largest - least, float((1 << bits) - 1)

    def value(self, steps: int) -> float:
        return steps * self.span / self.most + self.least

    def steps(self, value: float) -> int:
        """Nearest steps of a value, beyond the range its end. Raises ValueError for a number that is not finite."""
        if not math.isfinite(value):
            raise ValueError(f"{value} cannot be packed: expected a finite number")
        steps, most = (value - self.least) / self.span * self.most, self.most
        return round(steps) if 0.0 <= steps <= most else 0 if steps < 0.0 else int(most)


class Grid:
    """The values that packed fields can have, of ranges and bits that do not change; see `grid_of`."""

    __slots__ = ("kd", "kp", "position", "ranges", "torque", "velocity")

    def __init__(self, ranges: Ranges, bits: tuple[int, int, int, int, int]) -> None:
        """`bits` of position, velocity, kp, kd and torque."""
        self.ranges = ranges
        q, v, t, kp, kd = ranges
        self.position, self.velocity = PackedField(-q, q, bits[0]), PackedField(-v, v, bits[1])
        self.kp, self.kd, self.torque = (
            PackedField(0.0, kp, bits[2]),
            PackedField(0.0, kd, bits[3]),
            PackedField(-t, t, bits[4]),
        )

    def steps(self, command: MitCommand) -> tuple[int, int, int, int, int]:
        """Of a command's values; raises ValueError."""
        q, dq, kp, kd, torque = command
        return (
            self.position.steps(q),
            self.velocity.steps(dq),
            self.kp.steps(kp),
            self.kd.steps(kd),
            self.torque.steps(torque),
        )

    def command(self, q: int, dq: int, kp: int, kd: int, torque: int) -> MitCommand:
        return MitCommand(
            self.position.value(q),
            self.velocity.value(dq),
            self.kp.value(kp),
            self.kd.value(kd),
            self.torque.value(torque),
        )

    def feedback_steps(self, feedback: MitFeedback) -> tuple[int, int, int]:
        """Of a reply's values; raises ValueError."""
        q, dq, torque = feedback
        return self.position.steps(q), self.velocity.steps(dq), self.torque.steps(torque)

    def feedback(self, q: int, dq: int, torque: int) -> MitFeedback:
        return MitFeedback(self.position.value(q), self.velocity.value(dq), self.torque.value(torque))


@lru_cache(maxsize=256)
def grid_of(ranges: Ranges, bits: tuple[int, int, int, int, int] = MIT_BITS) -> Grid:
    return Grid(ranges, bits)


def pack_steps(q: int, dq: int, kp: int, kd: int, torque: int) -> bytes:
    return (q << 48 | dq << 36 | kp << 24 | kd << 12 | torque).to_bytes(8, "big")


def pack_command(command: MitCommand, grid: Grid) -> bytes:
    """The eight bytes of a command. Raises ValueError for numbers that are not finite."""
    return pack_steps(*grid.steps(command))


def unpack_command(data: bytes, grid: Grid) -> MitCommand:
    """A command as the drive understands it; `data` has eight bytes."""
    bits = int.from_bytes(data, "big")
    return grid.command(bits >> 48, bits >> 36 & 0xFFF, bits >> 24 & 0xFFF, bits >> 12 & 0xFFF, bits & 0xFFF)


def pack_feedback(feedback: MitFeedback, grid: Grid) -> bytes:
    """Bytes 1 to 5 of a reply: q 16 | dq 12 | τ 12 bits."""
    q, dq, torque = grid.feedback_steps(feedback)
    return (q << 24 | dq << 12 | torque).to_bytes(5, "big")


def unpack_feedback(data: bytes, grid: Grid) -> MitFeedback:
    """Feedback from bytes 1 to 5 of a reply, which `data` is."""
    bits = int.from_bytes(data, "big")
    return grid.feedback(bits >> 24, bits >> 12 & 0xFFF, bits & 0xFFF)


def unwrap(position: float, near: float, span: float) -> float:
    """The position that differs from the packed one by whole `span`s and is nearest to `near` [rad]."""
    return position + span * round((near - position) / span)
