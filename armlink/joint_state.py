"""`sensor_msgs/msg/JointState` as ROS 2 serialises it: CDR, little endian, doubles aligned to eight bytes."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

SCHEMA_NAME = "sensor_msgs/msg/JointState"
SCHEMA = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
"""Message definition in the form that rosbag2 stores (encoding `ros2msg`)."""

_HEADER = 4  # encapsulation; alignment counts from behind it
_NANO = 1_000_000_000


class JointState(NamedTuple):
    """One message; a list is empty or as long as `names`."""

    stamp: int
    """[ns]."""
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


@dataclass(frozen=True)
class _Reader:
    """Position in a CDR stream whose byte order is known."""

    data: bytes
    order: str

    def number(self, at: int) -> tuple[int, int]:
        at = _aligned(at, 4)
        return struct.unpack_from(self.order + "I", self.data, at)[0], at + 4

    def text(self, at: int) -> tuple[str, int]:
        length, at = self.number(at)
        return self.data[at : at + length].rstrip(b"\0").decode(), at + length

    def doubles(self, at: int) -> tuple[tuple[float, ...], int]:
        count, at = self.number(at)
        if not count:
            return (), at
        at = _aligned(at, 8)
        return struct.unpack_from(f"{self.order}{count}d", self.data, at), at + 8 * count


def decode_joint_state(data: bytes) -> JointState:
    """Decode one message; raises ValueError where the bytes are not one."""
    try:
        reader = _Reader(data, "<" if data[1] & 1 else ">")
        seconds, nanoseconds = struct.unpack_from(reader.order + "iI", data, _HEADER)
        _, at = reader.text(_HEADER + 8)
        count, at = reader.number(at)
        names = []
        for _ in range(count):
            name, at = reader.text(at)
            names.append(name)
        position, at = reader.doubles(at)
        velocity, at = reader.doubles(at)
        effort, at = reader.doubles(at)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"not a JointState message: {error}") from None
    return JointState(seconds * _NANO + nanoseconds, tuple(names), position, velocity, effort)


def joint_state_encoder(
    names: Sequence[str], lists: tuple[bool, bool, bool]
) -> Callable[[int, Sequence[float]], bytes]:
    """Encoder for messages of these names that carry position, velocity, effort or not (`lists`).

    It takes the stamp [ns] and the numbers of those lists one after the other, len(names) each.
    """
    head = bytearray(b"\0\1\0\0") + bytes(8) + struct.pack("<IB", 1, 0)  # stamp, empty frame_id
    head += bytes(_aligned(len(head), 4) - len(head)) + struct.pack("<I", len(names))
    for name in names:
        head += bytes(_aligned(len(head), 4) - len(head))
        text = name.encode() + b"\0"
        head += struct.pack("<I", len(text)) + text
    layout, counts = "<", []
    at = len(head)
    for there in lists:
        padded = _aligned(at, 4)
        layout += "x" * (padded - at) + "I"
        at = padded + 4
        counts.append(len(names) if there else 0)
        if there and names:
            padded = _aligned(at, 8)
            layout += "x" * (padded - at) + f"{len(names)}d"
            at = padded + 8 * len(names)
    body = struct.Struct(layout)
    stamped = struct.Struct("<4siI")
    encapsulation, rest = bytes(head[:_HEADER]), bytes(head[stamped.size :])
    n = len(names)

    def encode(stamp: int, numbers: Sequence[float]) -> bytes:
        values: list[float] = []
        taken = 0
        for count in counts:
            values.append(count)
            values.extend(numbers[taken : taken + count])
            taken += count
        if taken != len(numbers):
            raise ValueError(f"{len(numbers)} numbers for {sum(counts)} of {n} joints")
        return stamped.pack(encapsulation, *divmod(stamp, _NANO)) + rest + body.pack(*values)

    return encode


def _aligned(at: int, size: int) -> int:
    return at + (_HEADER - at) % size
