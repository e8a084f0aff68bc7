"""Bags as drivers record them: folders, several publishers, other message types, LeRobot data sets, foreign tables."""

import gc
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet
import pytest
from mcap_ros2.writer import Writer as RosWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armlink.errors import BadInput
from armlink.recording.corrections import parse_corrections
from armlink.recording.files import load_recording, load_recordings

CONTROLLER_STATE = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
"""
DYNAMIC_STATE = "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
INTERFACE_VALUE = "string[] interface_names\nfloat64[] values\n"


def store():
    types = get_typestore(Stores.ROS2_HUMBLE)
    for text, name in (
        (INTERFACE_VALUE, "control_msgs/msg/InterfaceValue"),
        (DYNAMIC_STATE, "control_msgs/msg/DynamicJointState"),
        (CONTROLLER_STATE, "control_msgs/msg/JointTrajectoryControllerState"),
    ):
        types.register(get_types_from_msg(text, name))
    return types


def header(types, nanoseconds: int):
    time = types.types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return types.types["std_msgs/msg/Header"](stamp=time, frame_id="")


def write(path, topics, storage=StoragePlugin.MCAP):
    """A bag folder of (topic, type, [(stamp in ns, fields)])."""
    types = store()
    with Writer(path, version=9, storage_plugin=storage) as bag:
        for topic, kind, messages in topics:
            connection = bag.add_connection(topic, kind, typestore=types)
            for stamp, fields in messages:
                message = types.types[kind](header=header(types, stamp), **fields(types))
                bag.write(connection, stamp, types.serialize_cdr(message, kind))


def states(names, positions, efforts=()):
    return lambda _: {
        "name": list(names),
        "position": np.array(positions, float),
        "velocity": np.zeros(0),
        "effort": np.array(efforts, float),
    }


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_folder_with_arm_and_gripper_on_one_topic(tmp_path, storage):
    arm = [(k * 10**7, states("ba", [0.1 * k, 1.0], [5.0, -k])) for k in range(20)]
    hand = [(k * 10**7 + 3, states(["finger"], [0.04])) for k in range(0, 20, 5)]
    kind = "sensor_msgs/msg/JointState"
    write(tmp_path / "bag", [("/joint_states", kind, sorted(arm + hand, key=lambda message: message[0]))], storage)
    loaded = load_recording(tmp_path / "bag")
    assert loaded.names == ("b", "a")
    np.testing.assert_allclose(loaded.position[:, 0], 0.1 * np.arange(20))
    np.testing.assert_allclose(loaded.torque[:, 1], -np.arange(20.0))
    assert "finger" in loaded.warning


def test_a_controllers_state_holds_the_command(tmp_path):
    def fields(types):
        point = types.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        still = types.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        made = [
            point(np.array(q), np.zeros(2), np.zeros(0), np.array(tau), still)
            for q, tau in (([1.0, 2.0], []), ([0.9, 1.9], [3.0, 4.0]))
        ]
        return {"joint_names": ["x", "y"], "reference": made[0], "feedback": made[1]}

    topic = "/arm_controller/controller_state"
    kind = "control_msgs/msg/JointTrajectoryControllerState"
    write(tmp_path / "bag", [(topic, kind, [(k * 10**7, fields) for k in range(5)])])
    loaded = load_recording(tmp_path / "bag")
    np.testing.assert_array_equal(loaded.position_command[0], [1.0, 2.0])
    np.testing.assert_array_equal(loaded.position[0], [0.9, 1.9])
    np.testing.assert_array_equal(loaded.torque[0], [3.0, 4.0])


def test_dynamic_joint_states_by_interface(tmp_path):
    def fields(types):
        value = types.types["control_msgs/msg/InterfaceValue"]
        rows = [
            value(interface_names=["effort", "position"], values=np.array([7.0, 0.5])),
            value(interface_names=["position"], values=np.array([0.6])),
        ]
        return {"joint_names": ["x", "y"], "interface_values": rows}

    kind = "control_msgs/msg/DynamicJointState"
    write(tmp_path / "bag", [("/dynamic_joint_states", kind, [(k * 10**7, fields) for k in range(5)])])
    loaded = load_recording(next((tmp_path / "bag").glob("*.mcap")))
    np.testing.assert_array_equal(loaded.position[0], [0.5, 0.6])
    assert loaded.torque[0, 0] == 7.0
    assert np.isnan(loaded.torque[0, 1])


def test_several_topics_must_be_named(tmp_path):
    messages = [(k * 10**7, states("ab", [k, 0], [1, 2])) for k in range(5)]
    kind = "sensor_msgs/msg/JointState"
    write(tmp_path / "bag", [("/left/joint_states", kind, messages), ("/right/joint_states", kind, messages)])
    with pytest.raises(BadInput, match="/left/joint_states, /right/joint_states: choose one with --topic"):
        load_recording(tmp_path / "bag")
    loaded = load_recording(tmp_path / "bag", parse_corrections(topic="/left/joint_states"))
    assert loaded.t.size == 5
    with pytest.raises(BadInput, match=r"no joint states on --topic /nope: the bag has /left"):
        load_recording(tmp_path / "bag", parse_corrections(topic="/nope"))


def test_a_file_of_the_stock_writer_on_another_topic(tmp_path):
    from armlink.recording.ros_joint_state import SCHEMA, SCHEMA_NAME

    with (tmp_path / "ur.mcap").open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(SCHEMA_NAME, SCHEMA)
        for k in range(6):
            stamp = {"sec": 3, "nanosec": k * 10**7}
            message = {
                "header": {"stamp": stamp, "frame_id": ""},
                "name": ["q"],
                "position": [k],
                "velocity": [],
                "effort": [2.0],
            }
            writer.write_message("/ur/joint_states", schema, message, k * 10**7, k * 10**7)
        writer.finish()
    loaded = load_recording(tmp_path / "ur.mcap")
    np.testing.assert_allclose(loaded.t, 0.01 * np.arange(6))


def test_a_broken_bag_is_one_line(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(BadInput, match="bag: cannot read the bag"):
        load_recording(tmp_path / "bag")
    with pytest.raises(BadInput, match="neither the folder of a ROS 2 bag"):
        load_recording(tmp_path)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_without_its_index_is_read_from_its_files(tmp_path, storage):
    """As a recorder that was killed leaves it: one file, or several of one recording."""
    kind = "sensor_msgs/msg/JointState"
    samples = [(k * 10**7, states("ba", [0.1 * k, 1.0], [5.0, -k])) for k in range(20)]
    whole = tmp_path / "whole"
    write(whole, [("/joint_states", kind, samples)], storage)
    (whole / "metadata.yaml").unlink()
    split = tmp_path / "split"
    split.mkdir()
    for number, part in enumerate((samples[:8], samples[8:])):
        write(tmp_path / f"part_{number}", [("/joint_states", kind, part)], storage)
        (file,) = (each for each in (tmp_path / f"part_{number}").iterdir() if each.name != "metadata.yaml")
        file.rename(split / f"split_{number}{file.suffix}")
    for folder in (whole, split):
        loaded = load_recording(folder)
        assert loaded.names == ("b", "a")
        np.testing.assert_allclose(loaded.position[:, 0], 0.1 * np.arange(20))
        np.testing.assert_allclose(loaded.torque[:, 1], -np.arange(20.0))


def test_a_topic_that_is_no_text_is_left_out(tmp_path):
    """The index of a bag is a file of its own, YAML; `.nan` there is a number, and equals nothing."""
    samples = [(k * 10**7, states("ba", [0.1 * k, 1.0])) for k in range(1, 5)]
    write(tmp_path / "bag", [("/state", "sensor_msgs/msg/JointState", samples)], StoragePlugin.SQLITE3)
    index = tmp_path / "bag" / "metadata.yaml"
    index.write_text(index.read_text().replace("name: /state", "name: .nan"))
    with pytest.raises(BadInput, match="no topic has messages of type sensor_msgs/msg/JointState"):
        load_recording(tmp_path / "bag")


def lerobot(folder):
    names = {"motors": ["shoulder.pos", "elbow.pos"]}
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(
        json.dumps({"fps": 30, "features": {"observation.state": {"names": names}}})
    )
    table = pa.table(
        {
            "episode_index": [0, 0, 0, 1, 1],
            "timestamp": [0.0, 0.033, 0.067, 0.0, 0.033],
            "observation.state": [[1.0, 2.0]] * 5,
            "action": [[1.1, 2.1]] * 5,
        }
    )
    pa_parquet.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")


def test_a_lerobot_data_set_is_a_recording_an_episode(tmp_path):
    lerobot(tmp_path / "set")
    found = load_recordings(tmp_path / "set", parse_corrections(units=["q=deg", "q_cmd=deg"]))
    assert [r.t.size for r in found.values()] == [3, 2]
    second = load_recording(f"{tmp_path / 'set'}#1", parse_corrections(units=["q=deg"]))
    assert second.names == ("shoulder", "elbow")
    np.testing.assert_allclose(second.position[0], np.radians([1.0, 2.0]))
    np.testing.assert_allclose(second.position_command[0], [1.1, 2.1])
    with pytest.raises(BadInput, match=r"holds 2 recordings: choose one, such as .*#0"):
        load_recording(tmp_path / "set")


def test_the_efforts_of_a_lerobot_data_set_are_read_for_poses_alone(tmp_path):
    lerobot(tmp_path / "set")
    file = tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet"
    table = pa_parquet.read_table(file).append_column("observation.effort", pa.array([[3.0, 4.0]] * 5))
    pa_parquet.write_table(table, file)
    described = {"observation.state": {"names": ["shoulder.pos", "elbow.pos"]}, "observation.effort": {"shape": [2]}}
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": described}))
    assert all(each.motor_torque is None for each in load_recordings(tmp_path / "set").values())
    for each in load_recordings(tmp_path / "set", poses=True).values():
        np.testing.assert_allclose(each.motor_torque[0], [3.0, 4.0])


@pytest.mark.parametrize(
    ("name", "column", "says"),
    [
        ("observation.state", [[1.0, 2.0], [1.0]], "rows of 1 values, but there are 2 names"),
        ("observation.state", [[1.0, 2.0], None], "rows of 0 values, but there are 2 names"),
        ("observation.state", [1.0, 2.0], "rows of 0 values, but there are 2 names"),
        ("observation.state", [["a", "b"]] * 2, "expected numbers"),
        ("action", [[[1.0, 2.0], [1.0, 2.0]]] * 2, "expected numbers"),
        ("timestamp", ["x", "y"], "expected numbers"),
        ("timestamp", [{"a": 1}] * 2, "expected numbers"),
        ("episode_index", [0.5, 1.0], "not a whole number"),
        ("episode_index", [None, 1], "not a whole number"),
        ("observation.\udcd2", [0, 1], "column observation.state is missing"),
    ],
)
def test_lerobot_files_that_do_not_fit_together_are_one_line(tmp_path, name, column, says):
    """Files of one data set may differ in their columns' types."""
    lerobot(tmp_path)
    first = tmp_path / "data" / "chunk-000" / "file-000.parquet"
    if "\udcd2" in name:
        place = first.read_bytes().replace(b"observation.state", b"observation.\xd2tate")
        first.with_name("file-001.parquet").write_bytes(place)
        says = "not the data of a LeRobot data set|column observation.state is missing"
    else:
        good = pa_parquet.read_table(first).slice(0, 2)
        changed = good.set_column(good.column_names.index(name), name, pa.array(column))
        pa_parquet.write_table(changed, first.with_name("file-001.parquet"))
    with pytest.raises(BadInput, match=says) as refused:
        load_recordings(tmp_path)
    assert "\n" not in str(refused.value)


def test_lerobot_files_of_integers_and_floats_are_one_data_set(tmp_path):
    lerobot(tmp_path)
    first = tmp_path / "data" / "chunk-000" / "file-000.parquet"
    good = pa_parquet.read_table(first)
    whole = good.set_column(2, "observation.state", pa.array([[1, 2]] * 5))
    whole = whole.set_column(0, "episode_index", pa.array([2, 2, 2, 3, 3]))
    pa_parquet.write_table(whole, first.with_name("file-001.parquet"))
    assert [label.rpartition("#")[2] for label in load_recordings(tmp_path)] == ["0", "1", "2", "3"]


@pytest.mark.parametrize("info", ["[" * 100_000, "{", '{"features": []}'])
def test_a_lerobot_data_set_without_names_or_rows_is_one_line(tmp_path, info):
    lerobot(tmp_path)
    first = tmp_path / "data" / "chunk-000" / "file-000.parquet"
    pa_parquet.write_table(pa_parquet.read_table(first).slice(0, 0), first)
    with pytest.raises(BadInput, match="have no rows"):
        load_recording(tmp_path)
    (tmp_path / "meta" / "info.json").write_text(info)
    with pytest.raises(BadInput, match="joint names of observation"):
        load_recording(tmp_path)


def test_a_foreign_table_gets_a_map_to_paste(tmp_path):
    path = tmp_path / "ur.csv"
    path.write_text("timestamp,actual_q_0,actual_q_1,actual_current_0,actual_current_1\n" + "0,1,2,3,4\n0.1,1,2,3,4\n")
    with pytest.raises(BadInput, match=r"column \w+ is missing") as error:
        load_recording(path)
    option = str(error.value).partition("--map ")[2]
    loaded = load_recording(path, parse_corrections(columns=[option], units=["tau_motor=A:10;20", "t=ms"]))
    np.testing.assert_array_equal(loaded.position[0], [1.0, 2.0])
    np.testing.assert_array_equal(loaded.motor_torque[0], [30.0, 80.0])
    assert loaded.t[1] == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sign": ["tau_9=-1"]}, "--sign tau_9: .* has no such column"),
        ({"sign": ["tau=2"]}, "expected 1 or -1"),
        ({"units": ["q=inch"]}, "--units q=inch: expected rad"),
        ({"units": ["tau=A:1;2;3"]}, "3 values are given, but .* has 2 joints"),
        ({"zero": ["q_1=a"]}, "--zero q_1=a: expected a number"),
        ({"columns": ["q_1"]}, "--map q_1: expected COLUMN=VALUE"),
        ({"columns": ["q_1=nope"]}, "--map q_1=nope: the file has no column nope"),
        ({"joints": "x,y"}, "--joints x: .* has only the joints"),
        ({"effort_is": "gear"}, "--effort-is gear: expected motor, link, without-gravity"),
    ],
)
def test_options_that_do_not_fit_are_one_line(tmp_path, options, message):
    path = tmp_path / "r.csv"
    path.write_text("t,q_1,q_2,tau_1,tau_2\n0,1,2,3,4\n0.1,1,2,3,4\n")
    with pytest.raises(BadInput, match=message):
        load_recording(path, parse_corrections(**options))


def ros1_bag(path, rows, compression=None):
    types = get_typestore(Stores.ROS1_NOETIC)
    kind = "sensor_msgs/msg/JointState"
    bag = Ros1Writer(path)
    if compression is not None:
        bag.set_compression(compression)
    with bag:
        connection = bag.add_connection("/joint_states", kind, typestore=types)
        for k, position in enumerate(rows):
            stamp = types.types["builtin_interfaces/msg/Time"](sec=7 + k // 100, nanosec=k % 100 * 10**7)
            head = types.types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="")
            effort = np.array([0.5 * k, -1.0])
            message = types.types[kind](head, ["b", "a"], np.array(position), np.zeros(0), effort)
            bag.write(connection, 7 * 10**9 + k * 10**7, types.serialize_ros1(message, kind))


@pytest.mark.parametrize("compression", [None, *Ros1Writer.CompressionFormat])
def test_a_bag_of_ros_1(tmp_path, compression):
    rows = np.random.default_rng(1128).uniform(-1.0, 1.0, (30, 2))
    ros1_bag(tmp_path / "run.bag", rows, compression)
    loaded = load_recording(tmp_path / "run.bag")
    assert loaded.names == ("b", "a")
    np.testing.assert_allclose(loaded.position, rows)
    np.testing.assert_allclose(loaded.torque[:, 0], 0.5 * np.arange(30))
    np.testing.assert_allclose(loaded.t, 0.01 * np.arange(30))


@pytest.mark.parametrize("compression", [*Ros1Writer.CompressionFormat])
def test_a_bag_of_ros_1_that_unpacks_to_too_much_is_refused(tmp_path, compression, monkeypatch):
    ros1_bag(tmp_path / "run.bag", np.zeros((1, 16 << 20)), compression)
    gc.collect()  # what the writer leaves would count as used before, and be free to use within the budget
    monkeypatch.setattr("armlink.content.memory_budget.LEAST_BUDGET", 32 << 20)
    with pytest.raises(BadInput, match=r"run\.bag: reading it would take more than"):
        load_recording(tmp_path / "run.bag")


def test_a_damaged_bag_of_ros_1_is_one_error(tmp_path):
    ros1_bag(tmp_path / "run.bag", np.zeros((50, 2)))
    whole = (tmp_path / "run.bag").read_bytes()
    random = np.random.default_rng(1128)
    for cut in random.integers(1, len(whole), 12).tolist():
        (tmp_path / "cut.bag").write_bytes(whole[:cut])
        with pytest.raises(BadInput, match=r"cut\.bag"):
            load_recording(tmp_path / "cut.bag")


def lerobot_with(path, state, action, described):
    values = np.random.default_rng(1128).uniform(-1.0, 1.0, (2, 40, 2))
    (path / "meta").mkdir(parents=True)
    (path / "data").mkdir()
    (path / "meta" / "info.json").write_text(json.dumps({"features": {state: described, action: described}}))
    columns = {
        "episode_index": np.zeros(40, int),
        "timestamp": 0.02 * np.arange(40),
        state: list(values[0]),
        action: list(values[1]),
    }
    pa_parquet.write_table(pa.table(columns), path / "data" / "a.parquet")
    return values


@pytest.mark.parametrize(
    ("state", "action", "described", "names"),
    [
        ("state", "actions", {"names": ["a.pos", "b.pos"], "shape": [2]}, ("a", "b")),
        ("observation.state", "action", {"names": {"left": ["a"], "right": ["b"]}, "shape": [2]}, ("a", "b")),
        ("observation.state", "action", {"names": [["a", "b"]], "shape": [2]}, ("a", "b")),
        ("state", "actions", {"names": None, "shape": [2]}, ("joint_1", "joint_2")),
    ],
)
def test_data_sets_of_other_recorders(tmp_path, state, action, described, names):
    values = lerobot_with(tmp_path / "set", state, action, described)
    (loaded,) = load_recordings(tmp_path / "set").values()
    assert loaded.names == names
    np.testing.assert_allclose(loaded.position, values[0])
    np.testing.assert_allclose(loaded.position_command, values[1])


def test_joint_names_of_a_data_set_occur_once(tmp_path):
    lerobot_with(tmp_path / "set", "state", "actions", {"names": {"left": ["a"], "right": ["a"]}, "shape": [2]})
    with pytest.raises(BadInput, match="occur twice"):
        load_recordings(tmp_path / "set")
