"""Real SocketCAN and real processes: a simulated arm, a host with the link, and a listener that watches both."""

import json
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest
from vcan_pair import pair_text

from armlink.drives.canopen.cia402 import DriveState, state_of
from armlink.guard import bus_guard

pytestmark = [pytest.mark.vcan, pytest.mark.long]  # quick: `tests/faults/test_vcan.py`, a link on the same bus

ROOT = Path(__file__).parents[3]
BUS = "socketcan:vcan0"
ARMLINK = str(Path(sys.executable).with_name("armlink"))

# Slow enough for one core of a user-mode kernel that runs everything; the deadline leaves room for a busy machine.
ARM = pair_text(0.5, None, 60.0)
STARTS = 4
"""What a busy machine makes late may be tried so often."""
PATIENCE = 600.0
"""A command that takes longer hangs, on a busy machine too [s]."""
HOST = """
import sys
from armlink.arm_file import load_arm
from armlink.link.link import Link
from armlink.link.types import Command
with Link.open(load_arm(sys.argv[1])) as link:
    link.start()
    sample = link.enable()
    command = Command.hold(sample.position)
    for cycle in range(int(sys.argv[2])):
        if cycle == 25:  # bias torque on joint 2
            command.mode[1], command.torque[1] = 10, 2.0
        link.cycle(command)
        if cycle == 40:
            print("pushing", flush=True)
    stats = link.stats
    print(f"rate {stats.rate_hz:.3f} missed {stats.missed} late {stats.late} load {stats.load:.4f}", flush=True)
"""


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "pair.yaml"
    path.write_text(ARM)
    return path


@pytest.fixture(scope="module")
def simulated(arm_file):
    if not Path("/sys/class/net/vcan0").exists():  # before the mark's own skip, since this fixture is the module's
        pytest.skip("needs a SocketCAN interface vcan0: run it with scripts/with-vcan .venv/bin/pytest -m vcan")
    command = [ARMLINK, "sim", str(arm_file), "--bus", BUS]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert "nodes 11, 12" in process.stderr.readline()
        yield process
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)


@pytest.fixture
def listener():
    status_words = [{"can_id": base, "can_mask": 0x780, "extended": False} for base in (0x280, 0x380)]
    with can.Bus(interface="socketcan", channel="vcan0", can_filters=status_words) as bus:
        yield bus


def host(arm_file, cycles):
    return subprocess.Popen(
        [sys.executable, "-c", HOST, str(arm_file), str(cycles)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )


def pushing(arm_file):
    """A host that goes on until it is ended; on a busy machine one may be late while it starts."""
    for _ in range(STARTS):
        process = host(arm_file, 100_000)
        if process.stdout.readline() == "pushing\n":
            return process
        process.communicate(timeout=30)
    raise AssertionError(f"none of {STARTS} hosts got as far as to push")


def armlink(*arguments):
    command = [ARMLINK, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, cwd=ROOT)


def states_of(bus, done, seconds):
    """States of the joints by the status words heard, until `done(states)` or the time is over."""
    states = {}
    end = time.monotonic() + seconds
    while not done(states) and (remaining := end - time.monotonic()) > 0:
        message = bus.recv(timeout=remaining)
        if message is not None:
            states[message.arbitration_id & 0x7F] = state_of(struct.unpack_from("<H", message.data)[0])
    return states


def all_are(state):
    return lambda states: states == {11: state, 12: state}


def test_an_arm_that_is_not_there_is_one_line(arm_file):
    scan = armlink("scan", arm_file, "--bus", BUS)
    assert scan.returncode == 3
    assert "no answer from joint_1 (node 11), joint_2 (node 12)" in scan.stderr.splitlines()[-1]


def test_a_killed_host_leaves_every_joint_in_quick_stop(simulated, arm_file, listener):
    process = pushing(arm_file)
    while listener.recv(timeout=0):
        pass
    assert all_are(DriveState.ENABLED)(states_of(listener, all_are(DriveState.ENABLED), 5.0))
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=30)
    assert states_of(listener, all_are(DriveState.QUICK_STOP), 5.0) == {
        11: DriveState.QUICK_STOP,
        12: DriveState.QUICK_STOP,
    }


def test_an_interrupted_host_quick_stops_itself(simulated, arm_file, listener):
    process = pushing(arm_file)
    process.send_signal(signal.SIGINT)
    process.wait(timeout=30)
    assert states_of(listener, all_are(DriveState.QUICK_STOP), 5.0) == {
        11: DriveState.QUICK_STOP,
        12: DriveState.QUICK_STOP,
    }


def test_the_host_keeps_no_higher_rate_than_it_should(simulated, arm_file):
    process = host(arm_file, 250)
    out, _ = process.communicate(timeout=60)
    words = out.splitlines()[-1].split()
    figures = dict(zip(words[::2], map(float, words[1::2]), strict=True))
    assert process.returncode == 0
    assert 0 < figures["rate"] <= 50.5
    assert figures["load"] > 0


def test_scan_and_monitor_see_the_arm(simulated, arm_file):
    scan = armlink("scan", arm_file, "--json", "-")
    assert scan.returncode == 0, scan.stderr
    assert '"joint": "joint_2"' in scan.stdout
    monitor = armlink("monitor", arm_file, "--once", "--sync", "--json", "-")
    assert monitor.returncode == 0, monitor.stderr
    assert '"nmt": "operational"' in monitor.stdout


def test_the_self_test_shows_that_the_joints_stop_without_their_host(simulated, arm_file):
    for _ in range(STARTS):  # on a busy machine replies are late
        check = armlink("check", arm_file, "--yes", "--json", "-")
        if check.returncode == 0:
            break
    answer = json.loads(check.stdout)
    assert check.returncode == 0, check.stderr
    silent = [each for each in answer["checks"] if each["check"] == "RPDO deadline"]
    assert [each["outcome"] for each in silent] == ["passed"] * 2
    assert all(0.4 < each["seconds"] < 0.85 for each in silent)
    alone = [each for each in answer["checks"] if each["check"] == "heartbeat of the host"]
    assert all(0.9 < each["seconds"] < 1.6 for each in alone)


def test_a_second_host_is_noticed(simulated, arm_file):
    process = pushing(arm_file)
    second = armlink("check", arm_file, "--yes")
    assert second.returncode == 3, second.stderr
    assert "another host is on this bus: it sends " in second.stderr
    process.send_signal(signal.SIGINT)
    process.wait(timeout=30)


@pytest.fixture
def guard(simulated, arm_file, tmp_path):
    """A guard between vcan1, for programs, and the arm's vcan0; its process."""
    if not Path("/sys/class/net/vcan1").exists():
        pytest.skip("needs a SocketCAN interface vcan1, which scripts/with-vcan makes where it makes vcan0")
    policy = tmp_path / "policy.json"
    written = armlink("guard", arm_file, "--out", policy)
    assert written.returncode == 0, written.stderr
    command = [sys.executable, "-I", bus_guard.__file__, str(policy), "vcan1", "vcan0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert "vcan1 may command vcan0" in process.stderr.readline()
        yield process
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)


def test_a_guard_passes_a_host_and_closes_at_a_torque_beyond_the_limit(guard, arm_file, listener, tmp_path):
    inside = tmp_path / "inside.yaml"
    inside.write_text(arm_file.read_text().replace("channel: vcan0", "channel: vcan1"))
    process = pushing(inside)
    with can.Bus(interface="socketcan", channel="vcan1") as intruder:
        intruder.send(can.Message(arbitration_id=0x20C, data=struct.pack("<Hhi", 15, 1000, 0), is_extended_id=False))
        assert "20Ch: target torque of joint_2 1000, allowed -750 to 750" in guard.stderr.readline()
    assert states_of(listener, all_are(DriveState.QUICK_STOP), 5.0) == {
        11: DriveState.QUICK_STOP,
        12: DriveState.QUICK_STOP,
    }
    process.communicate(timeout=30)
    assert process.returncode != 0
