"""The commands on a simulated arm in this process: answers, exit statuses, one line where something is wrong."""

import json

import numpy as np
import pytest

from armlink.cli import run
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording

BUS = "armlink_sim:sarcos"


def test_scan_lists_every_joint(capsys):
    assert run(["scan", "sarcos", "--bus", BUS, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [node["joint"] for node in answer["nodes"]] == [f"joint_{i}" for i in range(1, 8)]
    assert all(node["present"] and node["device_type"] == 0x20192 for node in answer["nodes"])
    assert {node["state"] for node in answer["nodes"]} == {"switch on disabled"}


def test_scan_without_an_arm_file_finds_the_nodes(capsys):
    assert run(["scan", "--bus", BUS, "--json", "-"]) == 0
    assert len(json.loads(capsys.readouterr().out)["nodes"]) == 7


def test_scan_names_a_joint_that_does_not_answer(tmp_path, capsys):
    from armlink.arm_file import bundled_arms

    text = bundled_arms()["sarcos"].read_text()
    (tmp_path / "other.yaml").write_text(text.replace("node: 3", "node: 33"))
    assert run(["scan", str(tmp_path / "other.yaml"), "--bus", BUS]) == 3
    assert "no answer from joint_3 (node 33)" in capsys.readouterr().err.splitlines()[-1]


def test_monitor_shows_joints_and_writes_what_it_saw(capsys):
    assert run(["monitor", "sarcos", "--bus", BUS, "--sync", "--cycles", "2", "--json", "-"]) == 0
    captured = capsys.readouterr()
    answer = json.loads(captured.out)
    assert answer["arm"] == "sarcos"
    assert answer["bus"]["rate_hz"] == pytest.approx(250)
    assert answer["bus"]["load"] == pytest.approx((47 + 7 * 111 * 1.25) * 250 / 1e6, rel=0.02)
    assert [joint["nmt"] for joint in answer["joints"]] == ["operational"] * 7
    assert answer["joints"][0]["torque"] != 0
    assert "joint_7" in captured.err


def test_monitor_of_a_silent_bus_says_so(capsys):
    assert run(["monitor", "sarcos", "--bus", BUS, "--once", "--json", "-"]) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["joints"][0]["position"] is None
    assert "no joint sends data: does a host send SYNC?" in captured.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["scan"], 2, "scan: give an arm file, or --bus"),
        (["scan", "sarcos", "--bus", "vcan0"], 2, "expected INTERFACE:CHANNEL[@BITRATE]"),
        (["scan", "--bus", "socketcan:nocan7"], 3, "bus socketcan:nocan7: cannot open it"),
        (["monitor", "nowhere"], 2, "no arm file nowhere"),
        (["monitor", "sarcos", "--bus", "socketcan:nocan7"], 3, "bus socketcan:nocan7: cannot open it"),
    ],
)
def test_what_is_wrong_is_one_line(arguments, status, says, capsys):
    assert run(arguments) == status
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert says in lines[0]


def test_convert_keeps_the_data_and_says_what_it_left_out(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("t,q_1,tau_1,gripper\n0,1,2,3\n0.5,1.5,,3\n")
    assert run(["convert", str(tmp_path / "a.csv"), str(tmp_path / "b.mcap"), "--json", "-"]) == 0
    captured = capsys.readouterr()
    answer = json.loads(captured.out)
    assert (answer["rows"], answer["channels"]) == (2, ["position", "torque"])
    assert "gripper" in captured.err
    assert run(["convert", str(tmp_path / "b.mcap"), str(tmp_path / "c.csv")]) == 0
    assert (tmp_path / "c.csv").read_text() == "t,q_1,tau_1\n0,1,2\n0.5,1.5,\n"


def test_convert_says_in_one_line_what_it_cannot_read_or_write(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("t,q_1,tau_1\n0,1,2\n0,1,2\n")
    assert run(["convert", str(tmp_path / "a.csv"), str(tmp_path / "b.mcap")]) == 2
    assert "row 2: t is 0 after 0, but time must increase" in capsys.readouterr().err
    (tmp_path / "a.csv").write_text("t,q_1,tau_1\n0,1,2\n1,1,2\n")
    assert run(["convert", str(tmp_path / "a.csv"), str(tmp_path / "none" / "b.parquet")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_monitor_stats_reports_the_cycle(capsys):
    assert run(["monitor", "sarcos", "--bus", BUS, "--sync", "--stats", "--cycles", "2", "--json", "-"]) == 0
    captured = capsys.readouterr()
    cycle = json.loads(captured.out)["cycle"]
    assert (cycle["cycles"], cycle["missed"]) == (99, 0)
    assert cycle["period_ms"] == pytest.approx(4.0)
    assert cycle["load"] == pytest.approx(0.25, rel=0.15)
    assert "p99.9" in captured.err


def test_convert_says_which_names_the_format_drops(tmp_path, capsys):
    recording = Recording(
        t=np.linspace(0, 1, 20), position=np.zeros((20, 2)), torque=np.ones((20, 2)), names=("left/elbow", "left/wrist")
    )
    save_recording(recording, tmp_path / "run.parquet")
    assert run(["convert", str(tmp_path / "run.parquet"), str(tmp_path / "run.csv")]) == 0
    assert "left/elbow is called joint_1, left/wrist is called joint_2" in " ".join(capsys.readouterr().out.split())
    assert run(["convert", str(tmp_path / "run.parquet"), str(tmp_path / "two.parquet")]) == 0
    assert "stores no joint names" not in capsys.readouterr().out
