"""armlink external without a recording: it listens beside the program that runs the arm, and sends nothing."""

import json
import os
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from fast_arm import FastArm
from fast_daemon import FastDaemon
from program_messages import ProgramMessages

from armlink import cli
from armlink.bus import open as bus_open
from armlink.bus.listening.joint_messages import ListeningBus
from armlink.recording.files import save_recording
from armlink.recording.recording import Recording

LEARNED_SECONDS = 90.0
PUSH = 8.0
"""Of joint 2 [N·m]."""
GROUP = "239.74.163.61"
READING = struct.Struct("<ii")
POSITION_UNIT, TORQUE_UNIT = 2 * np.pi / 2**20, 1e-6


def push(q: np.ndarray) -> np.ndarray:
    return np.where(np.arange(q.shape[1]) == 1, -PUSH, 0.0) + 0.0 * q


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[FastArm, list[str]]:
    """An arm, and the arguments with which its own work counts."""
    folder = tmp_path_factory.mktemp("live")
    daemon = FastDaemon(folder, 1)
    t, q, torque = (np.concatenate(column) for column in zip(*daemon.fast.samples(LEARNED_SECONDS), strict=True))
    save_recording(Recording(t=t - t[0], position=q, torque=torque), folder / "free.csv")
    known = ["--learned", str(folder / "kept.npz"), "--store", str(folder / "records.db")]
    assert cli.run(["external", "sarcos", "--baseline", str(folder / "free.csv"), *known]) == 0
    return daemon.fast, known


def followed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, list[Any], str]:
    status = cli.run(["external", "sarcos", *arguments, "--json", "-"])
    said = capsys.readouterr()
    return status, [json.loads(line) for line in said.out.splitlines()], said.err


def test_a_push_is_told_while_the_arm_works(learned, monkeypatch, capsys, tmp_path):
    fast, known = learned

    def pieces() -> Iterator[Any]:
        yield from fast.samples(20.0)
        fast.push = push
        yield from fast.samples(3.0)
        fast.push = None

    messages = ProgramMessages(fast.file.joint_names, pieces())
    messages.sleep_until(fast.t)
    bus = ListeningBus(messages, "ros2:/joint_states", fast.file.joint_names, rate=50.0, clock=messages)
    monkeypatch.setattr(bus_open, "open_listening_bus", lambda *given: bus)
    status, (header, *lines), said = followed(
        ["--ros2", "/joint_states", "--seconds", "30", "--foxglove", "0", *known], capsys
    )
    assert status == 0
    assert header["schema"] == "armlink.external-live/1"
    rows = [line for line in lines if "event" not in line]
    contacts = [line["event"] for line in lines if "event" in line]
    last = contacts[-1]
    assert "joint_2" in last["joints"]
    quiet, pushed = ([row for row in rows if low < row["t"] < high] for low, high in ((1.0, 19.0), (22.0, 99.0)))
    assert np.mean([abs(row["torque"][1]) < row["bound"][1] for row in quiet]) > 0.8
    assert np.median([row["torque"][1] for row in pushed]) == pytest.approx(PUSH, abs=3.0)
    assert {"force", "force_std", "moment", "moment_std", "load"} <= set(rows[0])
    assert f"{last['t']:9.2f} s  {last['kind']}" in said
    assert "± " in said
    assert "Foxglove: open ws://localhost:" in said
    assert "force at joint_7: x" in said


@pytest.mark.parametrize(
    ("interface", "channel"), [("udp_multicast", GROUP), pytest.param("socketcan", "vcan0", marks=pytest.mark.vcan)]
)
def test_no_frame_leaves_on_a_real_bus(learned, monkeypatch, capsys, interface, channel):
    fast, known = learned
    multicast = interface == "udp_multicast"
    options = {"port": 45300 + os.getpid() % 1000} if multicast else {"receive_own_messages": True}
    if not multicast and not Path("/sys/class/net/vcan0").exists():
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")
    monkeypatch.setenv("CAN_CONFIG", json.dumps(options if multicast else {}))
    over, sent, seen = threading.Event(), Counter[tuple[int, bytes]](), Counter[tuple[int, bytes]]()

    def host() -> None:
        """Readings of an arm at rest, which something pushes after 2 s."""
        q, cycle = fast.q, 0
        with can.Bus(channel, interface=interface, **options) as bus:
            while not over.is_set():
                fast.push = push if cycle > 100 else None
                torque = fast.read(q[None], 0.0 * q[None])[0]
                frames = [(0x80, b"")]
                for joint in range(fast.n):
                    units = round(q[joint] / POSITION_UNIT), round(torque[joint] / TORQUE_UNIT)
                    frames.append((0x181 + joint, READING.pack(*units)))
                for number, data in frames:
                    bus.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))
                    sent[number, data] += 1
                while (message := bus.recv(0.0)) is not None:  # its own frames, too
                    seen[message.arbitration_id, bytes(message.data)] += 1
                cycle += 1
                time.sleep(0.02)
        fast.push = None

    thread = threading.Thread(target=host)
    thread.start()
    try:
        status, (_, *lines), _ = followed(["--bus", f"{interface}:{channel}", "--seconds", "5", *known], capsys)
    finally:
        over.set()
        thread.join()
    assert status == 0
    assert seen
    assert not seen - sent
    assert any("torque" in line for line in lines)
    assert any("joint_2" in line["event"]["joints"] for line in lines if "event" in line)


def test_a_silent_bus_and_a_file_of_lines(learned, monkeypatch, capsys, tmp_path: Path):
    _, known = learned
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"port": 46300 + os.getpid() % 1000}))
    lines = tmp_path / "lines.jsonl"
    words = ["external", "sarcos", "--bus", f"udp_multicast:{GROUP}", "--seconds", "0.3", *known]
    assert cli.run([*words, "--json", str(lines)]) == 3
    assert "no SYNC was heard" in capsys.readouterr().err
    assert json.loads(lines.read_text())["joints"][0] == "joint_1"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("sarcos", "to listen to the arm, give --learned FILE or --baseline RECORDING"),
        ("sarcos run.csv --ros2 /joint_states", "run.csv: give recordings or a live source"),
        ("sarcos --ros2 /joint_states --bus virtual:x --learned kept.npz", "give only one of these options"),
        ("sarcos run.csv --foxglove 0", "--foxglove and --seconds are for listening"),
        ("sarcos run.csv --seconds 5", "--foxglove and --seconds are for listening"),
    ],
)
def test_what_does_not_go_together_is_one_line(capsys, words, said):
    assert cli.run(["external", *words.split()]) == 2
    assert said in capsys.readouterr().err
