"""Recordings as MCAP in the form of a ROS 2 bag: JointState messages on the topics of docs/formats.md.

`/joint_states` carries position, velocity and effort = torque sensor, `/motor_states` effort = motor torque,
`/joint_commands` position and effort = commanded position and torque. JointState has no temperature: joint
temperatures go as effort on `/joint_temperatures` [°C].
"""

import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Self

from lz4.frame import LZ4FrameDecompressor
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer
from zstandard import ZstdDecompressor, ZstdError

from armlink.arrays import Array
from armlink.content.atomic_file import FLUSH_SECONDS, open_whole
from armlink.errors import BadInput
from armlink.recording.joint_messages import (
    STATES,
    TOPICS,
    JointMessage,
    Lists,
    left_out_warning,
    main_joints,
    recording_of_messages,
)
from armlink.recording.recording import MOST_BYTES, Recording, require_size
from armlink.recording.ros_joint_state import NANO, SCHEMA, SCHEMA_NAME, JointStateDecoder, joint_state_encoder

MOST_CHUNK = 1 << 28
"""A chunk that unpacks to more bytes is refused; rosbag2 writes less than a thousandth of it."""
DAMAGED = (McapError, ValueError, OverflowError, OSError, struct.error, ZstdError)
"""Raised by the reading of a damaged file."""


class RecordingWriter:
    """Writes rows one by one; a context manager that completes the file."""

    def __init__(
        self, to: str | Path | IO[bytes], names: tuple[str, ...], topics: Mapping[str, Lists] = TOPICS
    ) -> None:
        """Create the file for joints with these names; a stream is written to, and left open."""
        self._own = isinstance(to, str | Path)
        self._stream = to if not isinstance(to, str | Path) else Path(to).open("wb")  # noqa: SIM115
        self._names, self._topics = names, topics
        self._writer = Writer(self._stream)
        self._writer.start(profile=Profile.ROS2, library="armlink")
        self._schema = self._writer.register_schema(SCHEMA_NAME, SchemaEncoding.ROS2, SCHEMA.encode())
        self._channels: dict[str, int] = {}
        self._encoders: dict[tuple[bool, bool, bool], Any] = {}
        self._flushed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.finish()
        if self._own:
            self._stream.close()

    def append(self, t: float, channels: Mapping[str, Array]) -> None:
        """Add one row at time `t` [s]: channel names of Recording → (n,) values; absent channels are not written."""
        stamp = round(t * NANO)
        for topic, of_topic in self._topics.items():
            lists = tuple(name is not None and name in channels for name in of_topic)
            if not any(lists):
                continue
            encode = self._encoders.get(lists)  # type: ignore[arg-type]
            if encode is None:
                encode = self._encoders[lists] = joint_state_encoder(self._names, lists)  # type: ignore[arg-type,index]
            numbers = [x for name in of_topic if name is not None and name in channels for x in channels[name].tolist()]
            self._writer.add_message(self._channel(topic), stamp, encode(stamp, numbers), stamp)
        if stamp - self._flushed > FLUSH_SECONDS * NANO:
            self._writer.flush()
            self._flushed = stamp

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.CDR, self._schema)
        return self._channels[topic]


def save_mcap(recording: Recording, path: Path) -> None:
    """Write a whole recording; times are kept to the nanosecond."""
    channels = recording.channels()
    with open_whole(path) as stream, RecordingWriter(stream, recording.names) as writer:
        for row, t in enumerate(recording.t.tolist()):
            writer.append(t, {name: values[row] for name, values in channels.items()})


def load_mcap(path: Path) -> Recording:
    """Load a recording or a ROS 2 bag in MCAP; a truncated file loads as far as it goes, noted in `warning`.

    Time is that of `/joint_states`, joints are those of its most frequent message.
    """
    messages, cut = _read(path)
    states = messages.pop(STATES, [])
    if not states:
        raise BadInput(f"{path}: no {SCHEMA_NAME} on {STATES}{f'; {cut}' if cut else ''}")
    names, alone = main_joints(states)
    if alone:
        cut = "; ".join(filter(None, (cut, left_out_warning(alone))))
        states = [state for state in states if set(names) <= set(state.names)]
    return recording_of_messages(states, list(messages.values()), names, str(path), cut)


def has_our_topics(path: Path) -> bool:
    """Whether a file's joint states are where this module looks, or cannot be told because it is cut."""
    try:
        with path.open("rb") as stream:
            summary = SeekingReader(stream, record_size_limit=_most_record(path)).get_summary()
    except DAMAGED:
        return True
    if summary is None or not summary.channels:
        return True
    kinds = {
        channel.topic: summary.schemas[channel.schema_id].name
        for channel in summary.channels.values()
        if channel.schema_id in summary.schemas
    }
    return STATES in kinds and all(kinds.get(topic, SCHEMA_NAME) == SCHEMA_NAME for topic in TOPICS)


def _read(path: Path) -> tuple[dict[str, list[JointMessage]], str]:
    """Messages by topic in the order of the file, and a warning if the file is truncated."""
    found: dict[str, list[JointMessage]] = defaultdict(list)
    topics: dict[int, str] = {}
    schemas: dict[int, Schema] = {}
    decode = JointStateDecoder()
    complete, why, size = False, "the file ends early", 0
    with path.open("rb") as stream:
        try:
            for record in _records(stream, path):
                if isinstance(record, Message) and record.channel_id in topics:
                    size += len(record.data)
                    require_size(size, str(path))
                    topic = topics[record.channel_id]
                    stamp, of, *lists = decode(record.data)
                    carried = {name: values for name, values in zip(TOPICS[topic], lists, strict=True) if name}
                    found[topic].append(JointMessage(stamp, of, carried))
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.topic in TOPICS:
                    _check_schema(record, schemas, path)
                    topics[record.id] = record.topic
                complete = complete or isinstance(record, Footer)
        except CRCValidationError as error:
            why = str(error)
        except RuntimeError as error:  # of LZ4
            why = f"a chunk cannot be unpacked ({error})"
        except DAMAGED:
            pass
        position = stream.tell()
    if complete:
        return found, ""
    rows = len(found.get(STATES, []))
    return found, f"truncated recording ({why}): the first {rows} rows were loaded, up to about byte {position}"


def _records(stream: IO[bytes], path: Path) -> Iterator[Any]:
    """Records of the file; raises BadInput where a chunk unpacks to more than a recording may hold."""
    most = _most_record(path)
    for record in StreamReader(stream, validate_crcs=True, emit_chunks=True, record_size_limit=most).records:
        if isinstance(record, Chunk):
            if record.uncompressed_size > MOST_CHUNK:
                size, most_size = record.uncompressed_size / 1e6, MOST_CHUNK / 1e6
                what = f"a chunk unpacks to {size:.0f} MB, expected at most {most_size:.0f} MB"
                raise BadInput(f"{path}: {what}: the file is damaged, or has to be written with smaller chunks")
            yield from breakup_chunk(_unpacked(record), validate_crc=True)
        else:
            yield record


def _most_record(path: Path) -> int:
    """Bytes that a record may have: what is stated beyond the file's own size is damage."""
    return min(path.stat().st_size, MOST_BYTES)


def _unpacked(chunk: Chunk) -> Chunk:
    """A chunk without its compression; unpacks no more than its header states, and raises ValueError beyond it."""
    if not chunk.compression:
        return chunk
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        data = ZstdDecompressor().stream_reader(chunk.data).read(most)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    else:
        raise ValueError(f"a chunk is compressed as {chunk.compression}, which is not supported")
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk does not unpack to {chunk.uncompressed_size} bytes")
    return replace(chunk, compression="", data=data)


def _check_schema(channel: Channel, schemas: dict[int, Schema], path: Path) -> None:
    schema = schemas.get(channel.schema_id)
    kind = schema.name if schema else "nothing"
    if kind != SCHEMA_NAME or channel.message_encoding != MessageEncoding.CDR:
        encoding = channel.message_encoding
        raise BadInput(f"{path}: {channel.topic} carries {kind} as {encoding}, expected {SCHEMA_NAME} as cdr")
