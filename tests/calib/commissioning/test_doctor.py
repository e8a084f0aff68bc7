"""What the doctor finds in arm files that somebody got wrong, and in what order."""

import copy
import json
import math
from pathlib import Path
from typing import get_args

import pytest
import yaml

from armlink import cli
from armlink.arm_file import bundled_arms
from armlink.drives.findings import Level
from calib.commissioning.doctor import examine

MODELS = Path(__file__).parents[2] / "models"
PLANAR = {
    "name": "planar",
    "serial": "SN-1",
    "kinematics": {
        "gravity": [0.0, 0.0, -9.81],
        "joints": [
            {"name": "shoulder", "alpha": 0.0, "a": 0.4, "lower": -2.0, "upper": 2.0},
            {"name": "elbow", "a": 0.3, "lower": -2.0, "upper": 2.0},
        ],
    },
    "link": {
        "bus": {"interface": "armlink_sim", "channel": "arm.yaml"},
        "joints": [
            {"name": "shoulder", "node": 1, "rated_torque": 40.0, "max_torque": 40.0, "max_torque_rate": 100.0},
            {"name": "elbow", "node": 2, "rated_torque": 20.0, "max_torque": 20.0, "max_torque_rate": 50.0},
        ],
    },
    "sim": {
        "links": [
            {"mass": 2.0, "com": [-0.2, 0, 0], "inertia": [0.01, 0.03, 0.03]},
            {"mass": 1.0, "com": [-0.15, 0, 0], "inertia": [0.01, 0.01, 0.01]},
        ]
    },
}
HORIZONTAL = [0.0, -9.81, 0.0]


def written(folder, *changes) -> str:
    """An arm file with changes ((keys…), value)."""
    content = copy.deepcopy(PLANAR)
    content["kinematics"]["gravity"] = HORIZONTAL
    for keys, value in changes:
        place = content
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
    (folder / "arm.yaml").write_text(yaml.safe_dump(content))
    return str(folder / "arm.yaml")


@pytest.mark.long
def test_a_damping_that_is_too_low_for_what_the_joint_turns_is_named(tmp_path):
    path = bundled_arms()["openarm"]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["kinematics"]["model"] = str(path.with_name(content["kinematics"]["model"]))

    def found():
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(content))
        return [each for each in examine(str(tmp_path / "arm.yaml"), offline=True) if "damping" in each.what]

    assert found() == []
    drive = content["link"]["joints"][3]["drive"]
    drive["kd"] = 1.0
    (named,) = found()
    assert (named.level, named.where) == ("warning", "openarm_right_joint4")
    inertia, kp = 0.26, 50.0
    assert named.what.startswith(f"kd 1 gives a damping ratio of only {1 / (2 * math.sqrt(kp * inertia)):.2f} at")
    assert "kd to 2.2 or more, or kp to 11 or less" in named.remedy
    drive["kd"] = 2.25
    assert found() == []


def test_a_sound_arm_has_no_error(tmp_path):
    assert [each for each in examine(written(tmp_path)) if each.level != "hint"] == []
    assert [each.level for each in examine("sarcos")] == ["hint", "hint"]


@pytest.mark.parametrize(
    ("keys", "value", "level", "words"),
    [
        (("link", "joints", 0, "max_torqe"), 3.0, "error", ["max_torqe", "did you mean max_torque?"]),
        (("link", "joints", 0, "torque_max"), 3.0, "error", ["did you mean max_torque?"]),
        (("kinematics", "gravitiy"), HORIZONTAL, "error", ["did you mean gravity?"]),
        (("likn",), {}, "error", ["did you mean link?"]),
        (("sweep",), {"hodl": "servo"}, "error", ["sweep.hodl", "did you mean hold?"]),
        (("link", "joints", 0, "rated_torque"), "40 Nm", "error", ["link.joints.0.rated_torque", "without 'Nm'"]),
        (("kinematics", "gravity"), [0, 0, -9.81], "error", ["kinematics.gravity", "gravity loads no joint"]),
        (("kinematics", "gravity"), [0, -1.6, 0], "warning", ["kinematics.gravity", "1.6"]),
        (("kinematics", "joints", 0, "upper"), -1.95, "error", ["shoulder", "left to sweep, at least 0.2 rad"]),
        (("serial",), "FILL-IN", "hint", ["serial is FILL-IN", "serial: …"]),
        (("link", "joints", 0, "max_torque"), 400.0, "warning", ["shoulder", "three times"]),
        (("link", "joints", 0, "max_torque_rate"), 9000.0, "hint", ["shoulder", "usual"]),
        (("link", "bus"), {"channel": "nosuch0"}, "error", ["nosuch0", "no interface"]),
        (("link", "bus"), {"interface": "pcna"}, "error", ["pcna"]),
        (("link", "bus", "bitrate"), 125000, "error", ["link.rate", "lower link.rate to"]),
        (("link", "bus", "channel"), "sarcos", "error", ["shoulder (node 1)", "6076h", "130"]),
    ],
)
def test_what_is_wrong_is_named_with_its_remedy(tmp_path, keys, value, level, words):
    found = examine(written(tmp_path, (keys, value)))
    lines = [str(each) for each in found if each.level == level]
    assert any(all(word in line for word in words) for line in lines), found
    assert all(each.remedy and each.what and each.where for each in found)


def test_without_a_serial_number_a_warning_comes_where_nothing_would_be_written_to_the_drives(tmp_path):
    """The demo writes to drives that end with it."""
    (found,) = [
        each for each in examine(written(tmp_path, (("serial",), "unknown")), offline=True) if "serial" in each.what
    ]
    assert found.level == "hint"
    real = written(tmp_path, (("serial",), "unknown"), (("link", "bus"), {"channel": "can0"}))
    (found,) = [each for each in examine(real, offline=True) if "serial" in each.what]
    assert found.level == "warning"


def test_a_drive_that_does_not_answer_and_one_that_nobody_knows(tmp_path):
    simulated = written(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    arm = written(other, (("link", "joints", 1, "node"), 9), (("link", "bus", "channel"), simulated))
    (found,) = [each for each in examine(arm) if each.level == "error"]
    assert found.where == "elbow (node 9)"
    assert "nodes 2 answer" in found.remedy


def test_findings_come_in_the_order_of_their_levels(tmp_path):
    arm = written(
        tmp_path,
        (("kinematics", "gravity"), [0, -1.6, 0]),
        (("link", "bus", "bitrate"), 125000),
        (("link", "joints", 0, "max_torque_rate"), 9000.0),
    )
    levels = [get_args(Level).index(each.level) for each in examine(arm)]
    assert levels == sorted(levels)
    assert {0, 1, 2} == set(levels)


def model_arm(folder, text: str, max_torque: float = 40.0, **more) -> str:
    (folder / "arm.xml").write_text(text)
    names = ["yaw", "pitch", "elbow", "roll"]
    joints = [
        {"name": name, "node": node, "rated_torque": max_torque, "max_torque": max_torque}
        for node, name in enumerate(names, start=1)
    ]
    content = {"name": "own", "kinematics": {"model": "arm.xml", "tip": "wrist"}, "sim": {}, **more}
    content["link"] = {"bus": {"interface": "armlink_sim", "channel": "arm.yaml"}, "joints": joints}
    (folder / "arm.yaml").write_text(yaml.safe_dump(content))
    return str(folder / "arm.yaml")


def test_of_a_model_collisions_weak_drives_and_absent_meshes_are_named(tmp_path):
    text = (MODELS / "own.xml").read_text()
    raised = text.replace('size="2 2 0.1"/>', 'size="2 2 0.1" pos="0 0 0.2"/>')
    lines = [str(each) for each in examine(model_arm(tmp_path, raised), offline=True)]
    assert any("in every combination of stops two bodies touch" in line for line in lines)
    text = text.replace('<geom type="plane" size="2 2 0.1"/>', "").replace(
        'type="capsule"', 'contype="0" type="capsule"'
    )
    weak = [each for each in examine(model_arm(tmp_path, text, max_torque=5.0), offline=True) if each.level == "error"]
    assert [each.where for each in weak[:1]] == ["pitch"]
    absent = text.replace("<worldbody>", '<asset><mesh name="m" file="gone.stl"/></asset><worldbody>', 1).replace(
        '<body name="palm"',
        '<body><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
        '<geom type="mesh" mesh="m"/></body><body name="palm"',
        1,
    )
    lines = [str(each) for each in examine(model_arm(tmp_path, absent), offline=True)]
    assert any("gone.stl" in line and "not found" in line for line in lines)


def test_the_command_answers_with_findings_and_status(tmp_path, capsys):
    assert cli.run(["doctor", written(tmp_path, (("link", "bus", "bitrate"), 125000)), "--json", "-"]) == 1
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert {*findings[0]} == {"level", "what", "where", "remedy"}
    assert findings[0]["level"] == "error"
    assert cli.run(["doctor", "sarcos", "--offline", "--json", "-"]) == 0
    assert cli.run(["doctor", "sarocs", "--json", "-"]) == 1
    assert "did you mean sarcos?" in capsys.readouterr().out
    assert "sarcos" in bundled_arms()


@pytest.mark.parametrize("turns", ["refuse", "auto"])
def test_a_drive_that_lost_a_turn_is_named_with_the_zero_that_puts_it_right(tmp_path, turns):
    lost = copy.deepcopy(PLANAR)
    lost["kinematics"]["gravity"] = HORIZONTAL
    lost["sim"]["sensors"] = {"position_offset": [0.0, -2 * math.pi]}
    (tmp_path / "lost.yaml").write_text(yaml.safe_dump(lost))
    elbow = {key: value for key, value in PLANAR["link"]["joints"][1].items() if key != "node"}
    elbow["drive"] = {"family": "canopen", "node": 2, "turns": turns}
    bus = {"interface": "armlink_sim", "channel": "lost.yaml"}
    found = examine(written(tmp_path, (("link", "joints", 1), elbow), (("link", "bus"), bus)))
    (named,) = [each for each in found if "beyond its stops" in each.what]
    assert named.where == "elbow (node 2)"
    if turns == "auto":
        assert named.level == "hint"
        assert "zero 6.2832 is used instead of 0, a whole turn more (`turns: auto`)" in named.remedy
    else:
        assert named.level == "error"
        assert "write `zero: 6.2832`" in named.remedy


def test_joints_that_nothing_stops_when_their_host_dies_are_named(tmp_path):
    def found(arm):
        return [each for each in examine(arm, offline=True) if "keep on with their last command" in each.what]

    assert [found(arm) for arm in ("six-piper", "six-myactuator", "sarcos")] == [[], [], []]
    unkept = tmp_path / "unkept.yaml"
    unkept.write_text(bundled_arms()["six-piper"].read_text(encoding="utf-8").replace("keeper: true", "keeper: false"))
    (named,) = found(unkept)
    assert named.level == "warning"
    assert "base, shoulder" in named.what


def test_joints_of_which_no_reading_shows_a_lost_turn_are_listed(tmp_path):
    (named,) = [
        each for each in examine("six-odrive", offline=True) if "may count one turn too many or too few" in each.what
    ]
    assert named.level == "hint"
    assert "base (0.524 rad), shoulder (0.524 rad), elbow (0.628 rad)" in named.what
    wide = written(tmp_path, (("kinematics", "joints", 0, "upper"), 4.4))
    (named,) = [each for each in examine(wide, offline=True) if "may count one turn too many or too few" in each.what]
    assert named.what.endswith("shoulder (6.28 rad)")
