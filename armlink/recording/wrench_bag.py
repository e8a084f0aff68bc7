"""External torque and wrench as a ROS 2 bag in MCAP: JointState of the joints, WrenchStamped at a frame."""

import struct
from pathlib import Path

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer

from armlink.arrays import Array
from armlink.content.atomic_file import open_whole
from armlink.recording.ros_joint_state import (
    LITTLE_ENDIAN,
    NANO,
    SCHEMA,
    SCHEMA_NAME,
    joint_state_encoder,
)

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


def save_wrench_bag(
    path: Path, t: Array, names: tuple[str, ...], torque: Array, std: Array, frame_id: str, wrench: Array
) -> None:
    """Write K rows: torques and their standard deviations (K, n) [N·m] as efforts, wrenches (K, 6) in base axes.

    NaN in a wrench is an axis that is not determined.
    """
    effort = joint_state_encoder(names, (False, False, True))
    with open_whole(path) as stream:
        writer = Writer(stream)
        writer.start(profile=Profile.ROS2, library="armlink")
        joints = writer.register_schema(SCHEMA_NAME, SchemaEncoding.ROS2, SCHEMA.encode())
        wrenches = writer.register_schema(WRENCH_NAME, SchemaEncoding.ROS2, WRENCH_SCHEMA.encode())
        topics = {
            topic: writer.register_channel(topic, MessageEncoding.CDR, schema)
            for topic, schema in ((TORQUE_TOPIC, joints), (BOUND_TOPIC, joints), (WRENCH_TOPIC, wrenches))
        }
        for row, seconds in enumerate(t.tolist()):
            stamp = round(seconds * NANO)
            for topic, data in (
                (TORQUE_TOPIC, effort(stamp, torque[row].tolist())),
                (BOUND_TOPIC, effort(stamp, std[row].tolist())),
                (WRENCH_TOPIC, encode_wrench(stamp, frame_id, wrench[row])),
            ):
                writer.add_message(topics[topic], stamp, data, stamp)
        writer.finish()
