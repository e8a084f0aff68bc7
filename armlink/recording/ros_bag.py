"""Bags of ROS as drivers record them: of ROS 2 a folder, `.db3` or `.mcap`, of ROS 1 `.bag`; any topic, several message
types.

`JointState` gives position, velocity and effort; `JointTrajectoryControllerState` also the commanded position;
`DynamicJointState` the interfaces named position, velocity and effort. `/motor_states`, `/joint_commands` and
`/joint_temperatures` add their channels as in `armlink.recording.mcap`.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from armlink.arrays import Array
from armlink.errors import ArmlinkError, BadInput
from armlink.recording.bag_sizes import require_bag_sizes
from armlink.recording.joint_messages import left_out, main_joints, nearest_rows
from armlink.recording.recording import MOST_JOINTS, Recording, require_size

TOPICS = {"/motor_states": "motor_torque", "/joint_commands": "torque_command", "/joint_temperatures": "temperature"}
"""Topics beside the states → channel that their efforts hold."""
_NANO = 1_000_000_000


@dataclass(frozen=True)
class BagMessage:
    """One message: its stamp [ns], joint names, and the channels that it carries."""

    stamp: int
    names: tuple[str, ...]
    channels: Mapping[str, Sequence[float]]


def load_bag(path: Path | Sequence[Path], topic: str = "") -> Recording:
    """Load a bag, or the files of one without its `metadata.yaml`: the joint states of `topic`.

    By default that is `/joint_states` or the only topic that carries some.

    Joints are those of the most frequent message; other topics' messages go to the row nearest in time. Raises BadInput
    where the topic must be named, or nothing can be read.
    """
    files = [path] if isinstance(path, Path) else list(path)
    path = files[0] if len(files) == 1 else files[0].parent
    for each in files:
        require_bag_sizes(each)
    try:
        with AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            readable = [c for c in reader.connections if isinstance(c.topic, str) and _short(c.msgtype) in _READERS]
            states = _state_connections(readable, topic, reader.connections, path)
            samples: dict[str, list[BagMessage]] = defaultdict(list)
            size = 0
            wanted = [*states, *(c for c in readable if c.topic in TOPICS and c not in states)]
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
    return _recording(main, samples, str(path))


def _state_connections(readable: Sequence[Any], topic: str, all_of_them: Iterable[Any], path: Path) -> list[Any]:
    """Connections of the topic that holds the joint states."""
    topics = sorted({c.topic for c in readable if c.topic not in TOPICS})
    if topic and topic not in topics:
        known = ", ".join(topics) or ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in all_of_them})) or "nothing"
        raise BadInput(f"{path}: no joint states on --topic {topic}: the bag has {known}")
    chosen = topic or ("/joint_states" if "/joint_states" in topics else topics[0] if len(topics) == 1 else "")
    if not topics:
        there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in all_of_them})) or "nothing"
        raise BadInput(f"{path}: no sensor_msgs/msg/JointState on /joint_states or another topic: the bag has {there}")
    if not chosen:
        raise BadInput(f"{path}: joint states on {', '.join(topics)}: name one with --topic")
    return [c for c in readable if c.topic == chosen]


def _recording(main: list[BagMessage], others: dict[str, list[BagMessage]], source: str) -> Recording:
    names, alone = main_joints([sample.names for sample in main])
    if len(names) > MOST_JOINTS:
        raise BadInput(f"{source}: {len(names)} joints in the joint states, expected at most {MOST_JOINTS}")
    main = sorted((s for s in main if set(names) <= set(s.names)), key=lambda s: s.stamp)
    stamps, rows = np.unique(np.array([s.stamp for s in main], dtype=np.int64), return_index=True)
    main = [main[row] for row in rows]
    channels = _channels(main, names, source)
    for topic, samples in others.items():
        values = _channels(samples, names, source)
        times = np.array([s.stamp for s in samples], dtype=np.int64)
        effort = values.pop("torque", None)
        if effort is not None:
            channels[TOPICS[topic]] = nearest_rows(effort, times, stamps)
        if topic == "/joint_commands" and "position" in values:
            channels["position_command"] = nearest_rows(values["position"], times, stamps)
    if "position" not in channels:
        raise BadInput(f"{source}: the joint states carry no position")
    return Recording(t=(stamps - stamps[0]) / _NANO, names=names, warning=left_out(alone), **channels)


def _channels(samples: list[BagMessage], names: tuple[str, ...], source: str) -> dict[str, Array]:
    """Channels of some samples (K, n) in the order of `names`, NaN for joints that a message lacks."""
    found: dict[str, Array] = {}
    for row, sample in enumerate(samples):
        for channel, values in sample.channels.items():
            if not len(values):
                continue
            if len(values) != len(sample.names):
                raise BadInput(
                    f"{source}: message {row + 1}: {len(values)} {channel} values of {len(sample.names)} joints"
                )
            table = found.setdefault(channel, np.full((len(samples), len(names)), np.nan))
            place = {name: i for i, name in enumerate(sample.names)}
            table[row] = [values[place[name]] if name in place else np.nan for name in names]
    return found


def _stamp(message: Any, receipt: int) -> int:
    """Stamp of the header, or the time of receipt where a driver leaves it empty [ns]."""
    stamp = int(message.header.stamp.sec) * _NANO + int(message.header.stamp.nanosec)
    return stamp or receipt


def _joint_state(message: Any, receipt: int) -> BagMessage:
    channels = {"position": message.position, "velocity": message.velocity, "torque": message.effort}
    return BagMessage(_stamp(message, receipt), tuple(message.name), channels)


def _controller_state(message: Any, receipt: int) -> BagMessage:
    measured = getattr(message, "feedback", None) or message.actual
    wanted = getattr(message, "reference", None) or message.desired
    channels = {
        "position": measured.positions,
        "velocity": measured.velocities,
        "torque": measured.effort,
        "position_command": wanted.positions,
    }
    return BagMessage(_stamp(message, receipt), tuple(message.joint_names), channels)


def _dynamic_state(message: Any, receipt: int) -> BagMessage:
    kinds = {"position": "position", "velocity": "velocity", "torque": "effort"}
    rows = [dict(zip(v.interface_names, v.values, strict=False)) for v in message.interface_values]
    channels = {
        channel: [row.get(kind, np.nan) for row in rows]
        for channel, kind in kinds.items()
        if any(kind in row for row in rows)
    }
    return BagMessage(_stamp(message, receipt), tuple(message.joint_names), channels)


def _short(kind: str) -> str:
    return kind.rpartition("/")[2]


_READERS: dict[str, Callable[[Any, int], BagMessage]] = {
    "JointState": _joint_state,
    "JointTrajectoryControllerState": _controller_state,
    "DynamicJointState": _dynamic_state,
}
