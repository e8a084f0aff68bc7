"""The live stream, read by a WebSocket client that speaks Foxglove's protocol."""

import asyncio
import json
import struct

import numpy as np
import pytest
from websockets.asyncio.client import connect

from armlink.errors import BadInput
from armlink.link.types import Sample
from armlink.monitor.streams import ExternalStream, FoxgloveStream
from armlink.recording.ros_joint_state import JointStateDecoder

NAMES = ("shoulder", "elbow")


def sample(torque=0.5):
    values = {"velocity": [0.1, np.nan], "torque": [torque, 2.0], "motor_torque": [0.4, 1.9]}
    arrays = {name: np.array(each) for name, each in values.items()}
    zero = np.zeros(2)
    return Sample(t=0.0, position=np.array([1.0, -1.0]), status=zero.astype(int), age=zero, **arrays)


async def first_messages(stream, send, topics_sent):
    """Schema and message by topic, as a client gets them that subscribes to everything."""
    found, topics = {}, {}
    sending = asyncio.create_task(send_on(send))
    async with connect(f"ws://127.0.0.1:{stream.port}", subprotocols=["foxglove.sdk.v1"]) as socket:
        while len(found) < topics_sent:
            content = await asyncio.wait_for(socket.recv(), 10)
            if isinstance(content, str):
                told = json.loads(content)
                if told["op"] == "advertise":
                    topics |= {each["id"]: each for each in told["channels"]}
                    asked = [{"id": each["id"], "channelId": each["id"]} for each in told["channels"]]
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            elif content[0] == 1:
                number, _ = struct.unpack_from("<IQ", content, 1)
                found[topics[number]["topic"]] = topics[number], content[13:]
    sending.cancel()
    return found


async def send_on(send):
    while True:
        send()
        await asyncio.sleep(0.05)


def test_a_client_gets_the_readings_as_joint_states():
    with FoxgloveStream("pair", NAMES, 0) as stream:
        found = asyncio.run(first_messages(stream, lambda: stream.send(sample()), 2))
    channel, data = found["/joint_states"]
    assert (channel["encoding"], channel["schemaName"]) == ("cdr", "sensor_msgs/msg/JointState")
    state = JointStateDecoder()(data)
    assert state.names == NAMES
    np.testing.assert_array_equal(state.position, [1.0, -1.0])
    np.testing.assert_array_equal(state.velocity, [0.1, np.nan])
    np.testing.assert_array_equal(state.effort, [0.5, 2.0])
    np.testing.assert_array_equal(JointStateDecoder()(found["/motor_states"][1]).effort, [0.4, 1.9])


def test_a_client_gets_external_torque_as_a_bag_has_it():
    torque, std, wrench = np.array([1.5, -0.5]), np.array([0.1, 0.2]), np.array([1.0, 2.0, 3.0, 0.1, np.nan, 0.3])
    with ExternalStream("pair", NAMES, "base", 0) as stream:
        found = asyncio.run(first_messages(stream, lambda: stream.send(torque, std, wrench), 3))
    for topic, wanted in (("/external_torque", torque), ("/external_torque_std", std)):
        state = JointStateDecoder()(found[topic][1])
        assert state.names == NAMES
        np.testing.assert_array_equal(state.effort, wanted)
    channel, data = found["/external_wrench"]
    assert channel["schemaName"] == "geometry_msgs/msg/WrenchStamped"
    np.testing.assert_array_equal(struct.unpack("<6d", data[-48:]), wrench)


def test_a_port_that_is_taken_is_one_line():
    with (
        FoxgloveStream("pair", NAMES, 0) as stream,
        pytest.raises(BadInput, match=f"--foxglove {stream.port}: cannot serve on 127.0.0.1: .*in use"),
    ):
        FoxgloveStream("pair", NAMES, stream.port)
