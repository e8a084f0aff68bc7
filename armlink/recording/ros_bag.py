"""Bags of ROS as drivers record them: of ROS 2 a folder, `.db3` or `.mcap`, of ROS 1 `.bag`; any topic, several message
types.

`JointState` gives position, velocity and effort; `JointTrajectoryControllerState` also the commanded position;
`DynamicJointState` the interfaces named position, velocity and effort. `/motor_states`, `/joint_commands` and
`/joint_temperatures` add their channels as in `armlink.recording.mcap`.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from zstandard import ZstdDecompressor, ZstdError

from armlink.content.file_content import parse_yaml, read_whole
from armlink.errors import ArmlinkError, BadInput
from armlink.recording.joint_messages import (
    STATES,
    TOPICS,
    JointMessage,
    left_out_warning,
    main_joints,
    recording_of_messages,
)
from armlink.recording.recording import PIECE_BYTES, Recording, require_size
from armlink.recording.ros_joint_state import NANO

SIDE_TOPICS = TOPICS.keys() - {STATES}
"""Topics beside the states."""
MOST_WINDOW = 1 << 27
"""Window of zstd [bytes]: what its own command allows without `--long`."""


def load_bag(files: Sequence[Path], topic: str = "") -> Recording:
    """Load a bag, its folder alone or the files of one without its `metadata.yaml`: the joint states of `topic`.

    By default that is `/joint_states` or the only topic that carries some.

    Joints are those of the most frequent message; other topics' messages go to the row nearest in time. Raises BadInput
    where the topic must be named, or nothing can be read.
    """
    path = files[0] if len(files) == 1 else files[0].parent
    for each in files:
        _require_room(each)
    try:
        with AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            readable = [c for c in reader.connections if isinstance(c.topic, str) and _short(c.msgtype) in _READERS]
            states = _state_connections(readable, topic, reader.connections, path)
            samples: dict[str, list[JointMessage]] = defaultdict(list)
            size = 0
            wanted = [*states, *(c for c in readable if c.topic in SIDE_TOPICS and c not in states)]
            for connection, receipt, raw in reader.messages(connections=wanted):
                size += len(raw)
                require_size(size, str(path))
                message = reader.deserialize(raw, connection.msgtype)
                samples[connection.topic].append(_READERS[_short(connection.msgtype)](message, receipt))
    except (ArmlinkError, MemoryError):
        raise
    except Exception as error:  # damaged files raise many kinds, those of each compression too
        raise BadInput(f"{path}: cannot read the bag: {str(error).partition(chr(10))[0]}") from None
    main = samples.pop(states[0].topic, [])
    if not main:
        raise BadInput(f"{path}: topic {states[0].topic} holds no message")
    names, alone = main_joints(main)
    by_stamp = {each.stamp: each for each in reversed(main) if set(names) <= set(each.names)}
    main = [by_stamp[stamp] for stamp in sorted(by_stamp)]
    others = [[_besides(topic, each) for each in messages] for topic, messages in samples.items()]
    return recording_of_messages(main, others, names, str(path), left_out_warning(alone))


def _require_room(path: Path) -> None:
    """Raise BadInput where rosbags would fill the disk with the packed files of a bag, or its description is too large.

    What else a bag unpacks to stays in memory, which has a budget.
    """
    description = path / "metadata.yaml"
    if description.is_file():
        parse_yaml(read_whole(description), description)
    for each in path.glob("*.zstd"):
        size = 0
        try:
            unpacker = ZstdDecompressor(max_window_size=MOST_WINDOW)
            with each.open("rb") as packed, unpacker.stream_reader(packed, read_across_frames=True) as stream:
                while piece := stream.read(PIECE_BYTES):
                    size += len(piece)
                    require_size(size, str(each))
        except (ZstdError, OSError) as error:
            raise BadInput(f"{each}: cannot be unpacked: {error}") from None


def _state_connections(readable: Sequence[Any], topic: str, all_of_them: Iterable[Any], path: Path) -> list[Any]:
    topics = sorted({c.topic for c in readable if c.topic not in SIDE_TOPICS})
    if topic and topic not in topics:
        known = ", ".join(topics) or ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in all_of_them})) or "nothing"
        raise BadInput(f"{path}: no joint states on --topic {topic}: the bag has {known}")
    chosen = topic or (STATES if STATES in topics else topics[0] if len(topics) == 1 else "")
    if not topics:
        there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in all_of_them})) or "nothing"
        raise BadInput(f"{path}: no topic has messages of type sensor_msgs/msg/JointState: the bag has {there}")
    if not chosen:
        raise BadInput(f"{path}: there are joint states on {', '.join(topics)}: choose one with --topic")
    return [c for c in readable if c.topic == chosen]


def _besides(topic: str, message: JointMessage) -> JointMessage:
    """A message of a topic beside the states, with the channels that its lists stand for there."""
    pairs = zip(TOPICS[STATES], TOPICS[topic], strict=True)
    carried = {there: message.channels[name] for name, there in pairs if name and there and name in message.channels}
    return message._replace(channels=carried)


def _stamp(message: Any, receipt: int) -> int:
    """Stamp of the header, or the time of receipt where a driver leaves it empty [ns]."""
    stamp = int(message.header.stamp.sec) * NANO + int(message.header.stamp.nanosec)
    return stamp or receipt


def _joint_state(message: Any, receipt: int) -> JointMessage:
    channels = {"position": message.position, "velocity": message.velocity, "torque": message.effort}
    return JointMessage(_stamp(message, receipt), tuple(message.name), channels)


def _controller_state(message: Any, receipt: int) -> JointMessage:
    measured = getattr(message, "feedback", None) or message.actual
    wanted = getattr(message, "reference", None) or message.desired
    channels = {
        "position": measured.positions,
        "velocity": measured.velocities,
        "torque": measured.effort,
        "position_command": wanted.positions,
    }
    return JointMessage(_stamp(message, receipt), tuple(message.joint_names), channels)


def _dynamic_state(message: Any, receipt: int) -> JointMessage:
    kinds = {"position": "position", "velocity": "velocity", "torque": "effort"}
    rows = [dict(zip(v.interface_names, v.values, strict=False)) for v in message.interface_values]
    channels = {
        channel: [row.get(kind, np.nan) for row in rows]
        for channel, kind in kinds.items()
        if any(kind in row for row in rows)
    }
    return JointMessage(_stamp(message, receipt), tuple(message.joint_names), channels)


def _short(kind: str) -> str:
    return kind.rpartition("/")[2]


_READERS: dict[str, Callable[[Any, int], JointMessage]] = {
    "JointState": _joint_state,
    "JointTrajectoryControllerState": _controller_state,
    "DynamicJointState": _dynamic_state,
}
