"""ROS 2 serialisation of `sensor_msgs/msg/JointState` in CDR: read by rosbags, written and read again by layout."""

import struct
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

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

LITTLE_ENDIAN = b"\0\1\0\0"
"""Encapsulation of a message in this order of bytes."""
_HEADER = 4  # encapsulation; alignment counts from its end
_STAMPED = 12  # encapsulation and stamp
NANO = 1_000_000_000


class JointState(NamedTuple):
    """One message; each list is empty or as long as `names`."""

    stamp: int
    """[ns]."""
    names: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


def _decoded(data: bytes) -> tuple[JointState, str]:
    from rosbags.serde import SerdeError

    try:
        message: Any = _type_store().deserialize_cdr(data, SCHEMA_NAME)
    except (SerdeError, ValueError) as error:
        raise ValueError(f"not a JointState message: {error}") from None
    stamp = message.header.stamp
    lists = (tuple(values.tolist()) for values in (message.position, message.velocity, message.effort))
    return JointState(stamp.sec * NANO + stamp.nanosec, tuple(message.name), *lists), message.header.frame_id


@cache
def _type_store() -> Any:
    from rosbags.typesys import Stores, get_typestore  # an extra, which writing does without

    return get_typestore(Stores.ROS2_HUMBLE)


class JointStateDecoder:
    """Decodes a stream of messages.

    A message with the layout of an earlier one takes a single compiled unpack, an eighth of the time that rosbags takes
    (5 of 38 µs, seven joints): an hour of an arm has millions of them.
    """

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
                    return JointState(seconds * NANO + nanoseconds, names, *lists)
        state, frame = _decoded(data)
        self._learn(data, state, frame)
        return state

    def _learn(self, data: bytes, state: JointState, frame: str) -> None:
        lists = (state.position, state.velocity, state.effort)
        if not data[1] & 1 or any(len(values) not in (0, len(state.names)) for values in lists):
            return
        there = (bool(lists[0]), bool(lists[1]), bool(lists[2]))
        at = _STAMPED + len(_head(state.names, frame))
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
    rest = _head(names)
    body = struct.Struct("<" + _body(_STAMPED + len(rest), len(names), lists)[0])
    counts = [len(names) if there else 0 for there in lists]
    stamped = struct.Struct("<4siI")
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
        return stamped.pack(LITTLE_ENDIAN, *divmod(stamp, NANO)) + rest + body.pack(*values)

    return encode


def _head(names: Sequence[str], frame: str = "") -> bytes:
    """The part between the stamp and the lists: the frame, and the names with their number."""
    head = bytearray(_STAMPED)

    def add(text: str) -> None:
        content = text.encode() + b"\0"
        head.extend(bytes(_aligned(len(head), 4) - len(head)) + struct.pack("<I", len(content)) + content)

    add(frame)
    head += bytes(_aligned(len(head), 4) - len(head)) + struct.pack("<I", len(names))
    for name in names:
        add(name)
    return bytes(head[_STAMPED:])


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
