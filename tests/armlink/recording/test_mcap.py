"""MCAP recordings: they open in ROS 2 tools, theirs open here, and a cut one loads up to the cut."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as RosWriter

from armlink.errors import BadInput
from armlink.recording.files import load_recording, save_recording
from armlink.recording.mcap import RecordingWriter
from armlink.recording.recording import Recording
from armlink.recording.ros_joint_state import (
    SCHEMA,
    SCHEMA_NAME,
    JointStateDecoder,
    joint_state_encoder,
)


def recording_of(rows=300, n=2):
    t = np.arange(rows) * 0.01
    position = np.sin(t)[:, None] * np.arange(1, n + 1)
    return Recording(t=t, position=position, torque=2 * position, motor_torque=3 * position)


def test_ros2_reads_what_we_write(tmp_path):
    recording = recording_of(rows=5)
    save_recording(recording, tmp_path / "r.mcap")
    seen = []
    with (tmp_path / "r.mcap").open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            seen.append((channel.topic, message.header.stamp.nanosec, list(message.position), list(message.effort)))
            assert message.name == ["joint_1", "joint_2"]
    assert [row for row in seen if row[0] == "/joint_states"] == [
        ("/joint_states", k * 10_000_000, recording.position[k].tolist(), recording.torque[k].tolist())
        for k in range(5)
    ]
    assert ("/motor_states", 20_000_000, [], recording.motor_torque[2].tolist()) in seen


def write_bag(path, messages):
    """As rosbag2 writes: (topic, t [s], names, position, velocity, effort)."""
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(SCHEMA_NAME, SCHEMA)
        for topic, t, names, position, velocity, effort in messages:
            stamp = {"sec": int(t), "nanosec": round(t % 1 * 1e9)}
            message = {
                "header": {"stamp": stamp, "frame_id": "base"},
                "name": names,
                "position": position,
                "velocity": velocity,
                "effort": effort,
            }
            writer.write_message(topic, schema, message, log_time=round(t * 1e9))
        writer.finish()


def test_a_ros2_bag_loads_as_it_is(tmp_path):
    epoch = 1_700_000_000.0
    messages = []
    for k in range(10):
        t = epoch + k / 100
        names = ["elbow", "shoulder"] if k % 2 else ["shoulder", "elbow"]  # publishers may reorder
        position = [2.0, 1.0] if k % 2 else [1.0, 2.0]
        messages.append(("/joint_states", t, names, position, [], [5.0, 5.0]))
        messages.append(("/joint_states_other", t, ["x"], [0.0], [], []))
        if k % 5 == 0:
            messages.append(("/motor_states", t + 0.003, ["elbow"], [], [], [7.0]))
    write_bag(tmp_path / "bag.mcap", messages)
    loaded = load_recording(tmp_path / "bag.mcap")
    assert loaded.names == ("shoulder", "elbow")
    np.testing.assert_allclose(loaded.t, np.arange(10) / 100, atol=1e-6)
    np.testing.assert_array_equal(loaded.position, [[1.0, 2.0]] * 10)
    assert loaded.velocity is None
    expected = np.full((10, 2), np.nan)
    expected[[0, 5], 1] = 7.0
    np.testing.assert_array_equal(loaded.motor_torque, expected)


@pytest.mark.parametrize(
    "lists", [(True, True, True), (True, False, True), (False, False, True), (False, False, False)]
)
@pytest.mark.parametrize("names", [(), ("a",), ("joint_1", "j2", "third joint")])
def test_the_codec_agrees_with_the_ros_library(lists, names):
    rng = np.random.default_rng(3)
    values = [rng.normal(size=len(names)).tolist() if there else [] for there in lists]
    ours = joint_state_encoder(names, lists)(5_000_000_007, [x for each in values for x in each])
    decoded = JointStateDecoder()(ours)
    assert decoded == (5_000_000_007, names, *map(tuple, values))
    stream = JointStateDecoder()
    assert stream(ours) == stream(ours) == decoded
    from mcap.records import Schema

    decode = DecoderFactory().decoder_for(
        "cdr", Schema(id=1, name=SCHEMA_NAME, encoding="ros2msg", data=SCHEMA.encode())
    )
    theirs = decode(ours)
    assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == (5, 7)
    assert tuple(theirs.name) == names
    assert [list(theirs.position), list(theirs.velocity), list(theirs.effort)] == values


def test_a_stream_decodes_as_single_messages_do():
    """Messages of one length that differ in names, lists, frame or byte order must not be taken for one another."""
    some = [
        joint_state_encoder(("ab", "cd"), (True, False, True))(7, [1.0, 2.0, 3.0, 4.0]),
        joint_state_encoder(("ab", "ce"), (True, True, False))(8, [1.0, 2.0, 3.0, 4.0]),
        joint_state_encoder(("ab", "cd"), (False, True, True))(9, [5.0, 6.0, 7.0, 8.0]),
        joint_state_encoder(("ab", "cd"), (True, False, True))(10, [1.5, 2.5, 3.5, 4.5]),
    ]
    assert len({len(data) for data in some}) < len(some)
    rng = np.random.default_rng(2)
    stream = JointStateDecoder()
    for choice in rng.integers(0, len(some), 200):
        assert stream(some[choice]) == JointStateDecoder()(some[choice])


@pytest.mark.parametrize(("rows", "cuts"), [(3, 200), (300, 40), pytest.param(3, None, marks=pytest.mark.long)])
def test_a_recording_cut_anywhere_loads_up_to_the_cut_and_says_so(tmp_path, rows, cuts):
    """The short one at some bytes, in the long test at every one, the long one, of many chunks, at some."""
    recording = recording_of(rows=rows)
    save_recording(recording, tmp_path / "whole.mcap")
    whole = (tmp_path / "whole.mcap").read_bytes()
    drawn = np.random.default_rng(0).integers(0, len(whole) - 8, cuts) if cuts else np.arange(len(whole))
    last = 0
    for cut in sorted(drawn.tolist()):
        (tmp_path / "cut.mcap").write_bytes(whole[:cut])
        try:
            loaded = load_recording(tmp_path / "cut.mcap")
        except BadInput:
            assert last == 0  # cut before the first row
            continue
        found = loaded.t.size
        assert found >= last
        last = found
        np.testing.assert_array_equal(loaded.position, recording.position[:found])
        assert f"the first {found} rows were loaded" in loaded.warning or found == rows
    assert last == rows


def test_a_recorder_that_is_killed_loses_at_most_the_last_second(tmp_path):
    recording = recording_of(rows=1000)
    writer = RecordingWriter(tmp_path / "r.mcap", recording.names)
    for row in range(1000):
        writer.append(recording.t[row], {"position": recording.position[row], "torque": recording.torque[row]})
    loaded = load_recording(tmp_path / "r.mcap")  # never closed
    assert recording.t[-1] - loaded.t[-1] < 1.0
    assert "truncated recording" in loaded.warning


def test_a_bag_without_joint_states_is_one_line(tmp_path):
    write_bag(tmp_path / "bag.mcap", [("/motor_states", 1.0, ["a"], [], [], [1.0])])
    with pytest.raises(BadInput, match="no topic has messages of type sensor_msgs/msg/JointState"):
        load_recording(tmp_path / "bag.mcap")
