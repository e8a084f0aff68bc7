"""Malformed arm files: one line that names the key, the value and what was expected."""

import copy
import math

import pytest
import yaml

from armlink.arm_file import load_arm
from armlink.errors import BadInput

GOOD = {
    "name": "arm",
    "kinematics": {
        "joints": [
            {"name": "joint_1", "lower": -1.0, "upper": 1.0},
            {"name": "joint_2", "a": 0.5, "lower": -1.0, "upper": 1.0},
        ]
    },
    "link": {
        "bus": {"interface": "socketcan", "channel": "vcan0"},
        "joints": [
            {"name": "joint_1", "node": 1, "rated_torque": 40.0, "max_torque": 30.0},
            {"name": "joint_2", "node": 2, "rated_torque": 40.0, "max_torque": 30.0},
        ],
    },
}
REMOVE = object()


def written(tmp_path, content):
    path = tmp_path / "arm.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def changed(keys, value):
    content = copy.deepcopy(GOOD)
    place = content
    for key in keys[:-1]:
        place = place[key]
    if value is REMOVE:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    return content


def test_defaults_are_those_of_the_contract(tmp_path):
    arm = load_arm(written(tmp_path, GOOD))
    link = arm.require_link()
    assert arm.kinematics.gravity == (0.0, 0.0, -9.80665)
    assert (link.rate, link.bus.bitrate, link.deadline) == (250.0, 1_000_000, 0.1)
    assert (link.joints[0].max_torque_rate, link.joints[0].max_velocity) == (200.0, 1.0)
    assert arm.joint_names == ("joint_1", "joint_2")
    assert len(arm.description_hash) == 64


@pytest.mark.parametrize(
    ("keys", "value", "says"),
    [
        (("colour",), "red", "key colour: unknown key"),
        (("link", "joints", 0, "torque_max"), 3.0, "key link.joints.0.torque_max: unknown key"),
        (("name",), REMOVE, "key name: Field required: add it"),
        (("kinematics", "joints", 1, "upper"), REMOVE, "key kinematics.joints.1.upper: Field required: add it"),
        (("kinematics", "joints", 1, "upper"), -2.0, "joint joint_2: lower -1.0 must be less than upper -2.0 [rad]"),
        (("kinematics", "joints", 0, "a"), "long", "key kinematics.joints.0.a: "),
        (("kinematics", "joints", 0, "a"), float("nan"), "key kinematics.joints.0.a: Input should be a finite number"),
        (("kinematics", "gravity"), [0.0, -9.8], "key kinematics.gravity: "),
        (("kinematics", "model"), "arm.xml", "give either `joints`"),
        (("kinematics", "joints", 1, "name"), "joint_1", "'joint_1' is given twice"),
        (("link", "joints", 1, "node"), 1, "'node 1' is given twice"),
        (
            ("link", "joints", 1, "node"),
            128,
            "key link.joints.1.node: Input should be less than or equal to 127 (value 128)",
        ),
        (
            ("link", "joints", 0, "max_torque"),
            -3,
            "key link.joints.0.max_torque: Input should be greater than 0 (value -3)",
        ),
        (("link", "joints", 0, "max_velocity"), math.inf, "key link.joints.0.max_velocity: Input should be a finite"),
        (("link", "joints", 0, "max_torque_rate"), math.inf, "max_torque_rate: Input should be a finite number"),
        (("link", "joints", 1, "name"), "wrist", "give both the same names in the same order"),
        (("link", "rate"), 0, "key link.rate: Input should be greater than 0 (value 0)"),
        (("link", "rate"), 4000, "key link.rate: Input should be less than or equal to 1000"),
        (("path",), "x", "`path` is not a key of an arm file"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, keys, value, says):
    path = written(tmp_path, changed(keys, value))
    with pytest.raises(BadInput) as caught:
        load_arm(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert says in message
    assert "\n" not in message
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("text", ["- a\n- b\n", "", "just words"])
def test_a_file_that_is_no_mapping(tmp_path, text):
    with pytest.raises(BadInput, match="an arm file is a mapping with the keys `name`, `kinematics` and `link`"):
        load_arm(written(tmp_path, text))


@pytest.mark.parametrize("text", ["a: [1, 2\n", "a: b: c\n"])
def test_a_file_that_is_no_yaml(tmp_path, text):
    with pytest.raises(BadInput, match="not YAML"):
        load_arm(written(tmp_path, text))


def test_an_arm_that_nobody_has():
    with pytest.raises(BadInput, match=r"no arm file nowhere: give a path, or a bundled arm \(.*sarcos"):
        load_arm("nowhere")


def test_what_a_command_needs_and_the_file_has_not(tmp_path):
    arm = load_arm(written(tmp_path, changed(("link",), REMOVE)))
    with pytest.raises(BadInput, match="key `link` is missing"):
        arm.require_link()


def test_another_description_has_another_hash(tmp_path):
    first = load_arm(written(tmp_path, GOOD)).description_hash
    second = load_arm(written(tmp_path, changed(("kinematics", "joints", 1, "a"), 0.50001))).description_hash
    third = load_arm(written(tmp_path, changed(("link", "rate"), 100))).description_hash
    assert first != second
    assert first == third


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name: 2026-13-45\n", "not YAML: month must be in 1..12"),
        ("name: " + "9" * 6000 + "\n", "not YAML: Exceeds the limit"),
        ("name: " + "[" * 3000 + "\n", "nested too deeply"),
        ("name: " + "{a: " * 3000 + "\n", "nested too deeply"),
        ("name: 2026-11-22\n", "key name: "),
    ],
)
def test_a_file_that_yaml_chokes_on_is_one_line(tmp_path, text, says):
    with pytest.raises(BadInput) as caught:
        load_arm(written(tmp_path, text))
    message = str(caught.value)
    assert says in message
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("name",), "../.."),
        (("name",), ".."),
        (("serial",), "a/b"),
        (("serial",), "c\\d"),
        (("name",), ""),
        (("name",), "two\nlines"),
        (("kinematics", "joints", 0, "name"), "../joint"),
        (("link", "joints", 0, "name"), "a\x1b[2J"),
        (("link", "joints", 0, "name"), "/joint"),
    ],
)
def test_a_name_is_one_line_and_no_path(tmp_path, keys, value):
    with pytest.raises(BadInput, match=rf"(key {'.'.join(map(str, keys))}|name is '\.\.')"):
        load_arm(written(tmp_path, changed(keys, value)))


def test_a_rated_torque_that_no_drive_can_be_told_is_one_line():
    from fake_joints import make_arm

    from armlink.link.joints.groups import make_groups

    with pytest.raises(BadInput, match=r"joint_1: rated_torque 1e-300 N·m: expected 0\.001 to"):
        make_groups(make_arm(2, joint={"rated_torque": 1e-300, "max_torque": 1e-300}))
