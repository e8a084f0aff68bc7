"""ROS 2 serialisation of `sensor_msgs/msg/JointState`: CDR, little endian, doubles aligned to eight bytes."""

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
"""Message definition as rosbag2 stores it (encoding `ros2msg`)."""

_HEADER = 4  # encapsulation; alignment counts from its end
_STAMPED = 12  # encapsulation and stamp
_NANO = 1_000_000_000


class JointState(NamedTuple):
    """One message; each list is empty or as long as `names`."""

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
    """Decode one message; raises ValueError if the bytes are malformed."""
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


class JointStateDecoder:
    """Decodes a stream of messages; a message with the layout of an earlier one takes a single compiled unpack."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[bytes, bytes, tuple[str, ...], struct.Struct, tuple[int, int, int]]] = {}

    def __call__(self, data: bytes) -> JointState:
        """Decode one message; raises ValueError if the bytes are malformed."""
        known = self._known.get(len(data))
        if known is not None:
            encapsulation, head, names, layout, counts = known
            if data[:_HEADER] == encapsulation and data[_STAMPED : _STAMPED + len(head)] == head:
                seconds, nanoseconds, *values = layout.unpack_from(data, _HEADER)
                lists = []
                at = 0
                for count in counts:
                    if values[at] != count:
                        break
                    lists.append(tuple(values[at + 1 : at + 1 + count]))
                    at += 1 + count
                else:
                    return JointState(seconds * _NANO + nanoseconds, names, *lists)
        state = decode_joint_state(data)
        self._learn(data, state)
        return state

    def _learn(self, data: bytes, state: JointState) -> None:
        lists = (state.position, state.velocity, state.effort)
        if not data[1] & 1 or any(len(values) not in (0, len(state.names)) for values in lists):
            return
        there = (bool(lists[0]), bool(lists[1]), bool(lists[2]))
        reader = _Reader(data, "<")
        _, at = reader.text(_STAMPED)
        at = reader.number(at)[1]
        for _ in state.names:
            at = reader.text(at)[1]
        body, end = _body(at, len(state.names), there)
        if end != len(data):
            return
        counts = (len(lists[0]), len(lists[1]), len(lists[2]))
        layout = struct.Struct(f"<iI{at - _STAMPED}x{body}")
        self._known[len(data)] = (data[:_HEADER], data[_STAMPED:at], state.names, layout, counts)


def joint_state_encoder(
    names: Sequence[str], lists: tuple[bool, bool, bool]
) -> Callable[[int, Sequence[float]], bytes]:
    """Encoder for messages with these names; `lists`: which of position, velocity and effort they carry.

    It takes the stamp [ns] and the numbers of those lists one after the other, len(names) each.
    """
    head = bytearray(b"\0\1\0\0") + bytes(8) + struct.pack("<IB", 1, 0)  # stamp, empty frame_id
    head += bytes(_aligned(len(head), 4) - len(head)) + struct.pack("<I", len(names))
    for name in names:
        head += bytes(_aligned(len(head), 4) - len(head))
        text = name.encode() + b"\0"
        head += struct.pack("<I", len(text)) + text
    body = struct.Struct("<" + _body(len(head), len(names), lists)[0])
    counts = [len(names) if there else 0 for there in lists]
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


def _body(at: int, n: int, lists: tuple[bool, bool, bool]) -> tuple[str, int]:
    """Struct codes of the three lists that begin at byte `at`, with counts and padding, and the byte behind them."""
    layout = ""
    for there in lists:
        padded = _aligned(at, 4)
        layout += "x" * (padded - at) + "I"
        at = padded + 4
        if there and n:
            padded = _aligned(at, 8)
            layout += "x" * (padded - at) + f"{n}d"
            at = padded + 8 * n
    return layout, at


def _aligned(at: int, size: int) -> int:
    return at + (_HEADER - at) % size
