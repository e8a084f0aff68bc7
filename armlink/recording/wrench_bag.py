"""External torque and wrench as messages of ROS 2 and as a bag of them: JointState of the joints, WrenchStamped."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from armlink.arrays import Array
from armlink.recording.ros_joint_state import LITTLE_ENDIAN, NANO, SCHEMA, SCHEMA_NAME, joint_state_encoder

TORQUE_TOPIC, BOUND_TOPIC, WRENCH_TOPIC = "/external_torque", "/external_torque_std", "/external_wrench"
WRENCH_NAME = "geometry_msgs/msg/WrenchStamped"
_LINE = "=" * 80
WRENCH_SCHEMA = f"""std_msgs/Header header
geometry_msgs/Wrench wrench
{_LINE}
MSG: geometry_msgs/Wrench
geometry_msgs/Vector3 force
geometry_msgs/Vector3 torque
{_LINE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_LINE}
{SCHEMA.partition(_LINE)[2].lstrip()}"""


def encode_wrench(stamp: int, frame_id: str, wrench: Array) -> bytes:
    """WrenchStamped in CDR: time [ns], force [N] and moment [N·m] (6,)."""
    name = frame_id.encode() + b"\0"
    head = struct.pack("<iII", stamp // NANO, stamp % NANO, len(name)) + name
    return LITTLE_ENDIAN + head + b"\0" * (-len(head) % 8) + struct.pack("<6d", *wrench.tolist())


TOPICS = {
    TORQUE_TOPIC: (SCHEMA_NAME, SCHEMA),
    BOUND_TOPIC: (SCHEMA_NAME, SCHEMA),
    WRENCH_TOPIC: (WRENCH_NAME, WRENCH_SCHEMA),
}
"""Topic → name and text of its schema."""


def external_encoder(
    names: tuple[str, ...], frame_id: str
) -> Callable[[int, Array, Array, Array], Iterator[tuple[str, bytes]]]:
    """Encodes torques, their standard deviations (n,) [N·m] and a wrench (6,) of a time [ns]: topics and messages."""
    effort = joint_state_encoder(names, (False, False, True))

    def encode(stamp: int, torque: Array, std: Array, wrench: Array) -> Iterator[tuple[str, bytes]]:
        yield TORQUE_TOPIC, effort(stamp, torque.tolist())
        yield BOUND_TOPIC, effort(stamp, std.tolist())
        yield WRENCH_TOPIC, encode_wrench(stamp, frame_id, wrench)

    return encode


def save_wrench_bag(
    path: Path, t: Array, names: tuple[str, ...], torque: Array, std: Array, frame_id: str, wrench: Array
) -> None:
    """Write K rows: torques and their standard deviations (K, n) [N·m] as efforts, wrenches (K, 6) in base axes.

    NaN in a wrench is an axis that is not determined.
    """
    from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
    from mcap.writer import Writer

    from armlink.content.atomic_file import open_whole

    encode = external_encoder(names, frame_id)
    with open_whole(path) as stream:
        writer = Writer(stream)
        writer.start(profile=Profile.ROS2, library="armlink")
        schemas = {
            schema: writer.register_schema(schema, SchemaEncoding.ROS2, text.encode())
            for schema, text in TOPICS.values()
        }
        channels = {
            topic: writer.register_channel(topic, MessageEncoding.CDR, schemas[schema])
            for topic, (schema, _) in TOPICS.items()
        }
        for row, seconds in enumerate(t.tolist()):
            stamp = round(seconds * NANO)
            for topic, data in encode(stamp, torque[row], std[row], wrench[row]):
                writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()
