"""armlink observe: a drift of an arm that another program commands, heard from messages or found in a recording."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fast_daemon import FastDaemon
from program_messages import ProgramMessages

from armlink import cli
from armlink.arm_file import load_arm
from armlink.bus import open as bus_open
from armlink.bus.listening.joint_messages import ListeningBus
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from calib.commands.observe import recorded

SECONDS, BEFORE = 300.0, 60.0


@pytest.fixture
def drifting(tmp_path: Path) -> FastDaemon:
    """Records of a fast arm, which then drifts."""
    daemon = FastDaemon(tmp_path, 1)
    daemon.drift()
    return daemon


def observed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, Any]:
    status = cli.run(["observe", "sarcos", *arguments, "--json", "-"])
    return status, json.loads(capsys.readouterr().out)


def test_a_drift_is_heard_from_messages(
    drifting: FastDaemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = drifting.arm.joint_names
    messages = ProgramMessages(names, drifting.fast.samples(SECONDS))
    bus = ListeningBus(messages, "ros2:/joint_states", names, rate=50.0, clock=messages)
    monkeypatch.setattr(bus_open, "open_listening_bus", lambda *given: bus)
    store = ["--store", str(tmp_path / "records.db")]
    status, answer = observed(["--ros2", "/joint_states", "--seconds", str(SECONDS), *store], capsys)
    assert status == 1
    drifts = [each for each in answer["events"] if each["kind"] == "drift"]
    assert {each["joint"] for each in drifts} == {names[2]}
    assert answer["gain"][2] == pytest.approx(1.03, abs=0.01)
    assert not bus.remarks


def test_a_drift_is_found_in_a_recording(
    drifting: FastDaemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t, position, torque = (np.concatenate(column) for column in zip(*drifting.fast.samples(SECONDS), strict=True))
    save_recording(Recording(t=t - t[0], position=position, torque=torque), tmp_path / "run.csv")
    store = ["--store", str(tmp_path / "records.db")]
    status, answer = observed([str(tmp_path / "run.csv"), *store], capsys)
    assert (status, answer["samples"]) == (1, t.size)
    assert {each["joint"] for each in answer["events"] if each["kind"] == "drift"} == {drifting.arm.joint_names[2]}


def test_a_sound_arm_and_two_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    daemon = FastDaemon(tmp_path, 1)
    t, position, torque = (np.concatenate(column) for column in zip(*daemon.fast.samples(BEFORE), strict=True))
    save_recording(Recording(t=t - t[0], position=position, torque=torque), tmp_path / "run.csv")
    store = ["--store", str(tmp_path / "records.db")]
    assert observed([str(tmp_path / "run.csv"), *store], capsys)[0] == 0
    assert cli.run(["observe", "sarcos", str(tmp_path / "run.csv"), "--ros2", "/joint_states", *store]) == 2
    assert cli.run(["observe", "sarcos", "--bus", "virtual:x", "--ros2", "/joint_states", *store]) == 2


def test_joints_of_a_recording_are_found_by_their_names(tmp_path: Path) -> None:
    arm = load_arm("sarcos")
    t, values = np.arange(0.0, 1.0, 0.1), np.arange(70.0).reshape(10, 7)
    turned = Recording(t=t, position=values, torque=values + 0.5, names=arm.joint_names[::-1])
    save_recording(turned, tmp_path / "run.mcap")
    rows = list(recorded(arm, tmp_path / "run.mcap"))
    assert np.array([q for _, q, _ in rows]) == pytest.approx(values[:, ::-1])
    assert np.array([torque for _, _, torque in rows]) == pytest.approx(values[:, ::-1] + 0.5)
