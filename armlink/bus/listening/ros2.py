"""Joint states of a ROS 2 system (sensor_msgs/JointState on a topic), by DDS, without an installation of ROS.

The reader asks for best effort: it acknowledges nothing, so no publisher ever waits for it or sends anything again. The
module makes no writer. What DDS itself sends is discovery, by which publishers learn that there is a reader.

ROS_DOMAIN_ID says which domain, as in ROS; CYCLONEDDS_URI configures CycloneDDS.
"""

import os
import time
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from armlink.bus.listening.joint_messages import JointStateMessage
from armlink.errors import BadInput, BusFault

MOST_DOMAIN = 232
"""Largest domain id whose ports are below 65536 (DDSI-RTPS 2.5, 9.6.1.1)."""
KEPT_MESSAGES = 1000
"""Messages that wait while nobody reads: a second of the fastest publisher."""


RosTime = make_idl_struct("RosTime", "builtin_interfaces::msg::dds_::Time_", {"sec": int32, "nanosec": uint32})
RosHeader = make_idl_struct("RosHeader", "std_msgs::msg::dds_::Header_", {"stamp": RosTime, "frame_id": str})
RosJointState = make_idl_struct(
    "RosJointState",
    "sensor_msgs::msg::dds_::JointState_",
    {"header": RosHeader, "name": sequence[str]} | dict.fromkeys(("position", "velocity", "effort"), sequence[float64]),
)


class RosTopic:
    """Messages of one topic, of whatever publishers there are."""

    def __init__(self, topic: str) -> None:
        """Raises BadInput for an impossible domain, BusFault where DDS cannot be had."""
        self._topic, self._domain = topic, _domain()
        quality = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(KEPT_MESSAGES))
        try:
            participant = DomainParticipant(self._domain)
            named = Topic(participant, f"rt/{topic.lstrip('/')}", RosJointState, qos=quality)
            self._entities: list[Any] = [DataReader(participant, named, qos=quality), participant]
            """The reader, and the participant that ends with its last reference; empty once closed."""
        except DDSException as error:
            raise BusFault(f"bus ros2:{topic}: cannot open it: {error}") from None
        self.lost = 0

    def take(self) -> list[JointStateMessage]:
        try:
            samples = self._entities[0].take(KEPT_MESSAGES) if self._entities else []
        except DDSException as error:
            raise BusFault(f"bus ros2:{self._topic}: cannot read it: {error}") from None
        now = time.monotonic()
        return [
            _message(each, now) for each in samples if isinstance(each, RosJointState) and each.sample_info.valid_data
        ]

    def absence(self) -> str:
        return (
            f"does a publisher of {self._topic} run in ROS domain {self._domain} (ROS_DOMAIN_ID), and does this "
            "computer reach it (ROS_LOCALHOST_ONLY, firewall)?"
        )

    def close(self) -> None:
        self._entities.clear()


def _message(sample: Any, arrived: float) -> JointStateMessage:
    """With the header's stamp; where the publisher leaves that empty, with the time at which it wrote the message."""
    stamp = sample.header.stamp.sec + sample.header.stamp.nanosec * 1e-9 or sample.sample_info.source_timestamp * 1e-9
    source = sample.sample_info.publication_handle
    return JointStateMessage(source, arrived, stamp, sample.name, sample.position, sample.velocity, sample.effort)


def _domain() -> int:
    given = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not (given.isdigit() and int(given) <= MOST_DOMAIN):
        raise BadInput(f"ROS_DOMAIN_ID is {given!r}, expected a whole number from 0 to {MOST_DOMAIN}")
    return int(given)
