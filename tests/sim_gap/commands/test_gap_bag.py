"""A bag whose joints are in alphabetical order, on the command line: corrections number the joints from base to tip."""

import json

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from wrong_arms import THREE, Wrong, model, record

from armlink.cli import run

NAMES = ("shoulder", "forearm", "elbow")
"""Base to tip: the bag has the tip first."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Folder with the arm's model, and a bag whose base joint has the opposite sign of torque."""
    folder = tmp_path_factory.mktemp("bag")
    xml = THREE
    for k, name in enumerate(NAMES, start=1):
        xml = xml.replace(f"joint_{k}", name)
    (folder / "arm.xml").write_text(xml)
    made = record(model(), Wrong(), seconds=20.0, rate=50.0)
    torque = made.torque * np.array([-1.0, 1.0, 1.0])
    order = [NAMES.index(name) for name in sorted(NAMES)]
    types = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    with Writer(folder / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=types)
        for t, q, tau in zip(
            made.t, np.ascontiguousarray(made.position[:, order]), np.ascontiguousarray(torque[:, order]), strict=True
        ):
            stamp = round(t * 1e9)
            time = types.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            header = types.types["std_msgs/msg/Header"](stamp=time, frame_id="")
            message = types.types[kind](header, sorted(NAMES), q, np.zeros(0), tau)
            writer.write(connection, stamp, types.serialize_cdr(message, kind))
    return folder


def diagnosed(folder, capsys, *options):
    status = run(["gap", "diagnose", "--sim", str(folder / "arm.xml"), "--train", str(folder / "run"), *options])
    return status, capsys.readouterr()


def test_a_sign_is_that_of_the_joint_counted_from_the_base(bag, capsys):
    status, _ = diagnosed(bag, capsys, "--sign", "tau_1=-1", "--effort-is", "link", "--json", str(bag / "answer.json"))
    answer = json.loads((bag / "answer.json").read_text())
    assert status == 0
    assert answer["checks"] == []
    assert answer["verdict"] == "no_gap"


def test_the_option_that_is_printed_numbers_the_joints_so_too(bag, capsys):
    """Without `metadata.yaml`, as a recorder that was killed leaves a bag."""
    (bag / "run" / "metadata.yaml").unlink()
    status, said = diagnosed(bag, capsys, "--effort-is", "link", "--json", str(bag / "answer.json"))
    assert status == 0
    (finding,) = json.loads((bag / "answer.json").read_text())["checks"]
    assert (finding["joint"], finding["option"]) == ("shoulder", "--sign tau_1=-1")
    assert "tau of shoulder: the sign is opposite" in said.out
