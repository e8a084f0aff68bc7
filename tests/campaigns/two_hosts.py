"""Listening beside the stock client of each family in real time: record, monitor, daemon --listen-only send no frame.

`two_hosts.py [--seconds 600] [--arm six-damiao …] [--group 239.74.163.77]`. For each arm, side by side: a simulated arm
in one process, the stock client that sways all its joints in another (stock_hosts.py), the three listeners, all on one
udp_multicast bus with a port of its own. A witness counts the frames by the socket that sent them. Exit status 0 where
only the sockets of arm and client have sent, every listener saw the joints move, and the recording has the motion that
the client ordered and, of drives with gains, the torque that its commands ask for.
"""

import argparse
import contextlib
import http.client
import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from stock_hosts import HOSTS, RATE, SECONDS, SWAY, gains

from armlink.arm_file import bundled_arms
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording

ARMLINK = [sys.executable, "-m", "armlink.cli"]
PORT = 43113
"""Of the first bus; the others have the next ones."""
STARTS = 6.0
"""Time for each process to begin [s]."""
MOST_STARTS = 10
"""A busy machine may take so many times as long to begin."""
PATIENCE = 5.0
"""Deadline of the drives [s]: the machine is full."""
LONGEST_TIMEOUT = 100_000
"""The same of CubeMars drives, as long as they can be set to [cycles of theirs]."""
MOVED = 0.2
"""A listener must have seen every joint move so far [rad]."""
FOLLOWED = 0.08
"""RMS of target less position, at most [rad]: the joints sag, and MIT drives have no integral term."""
WITH_GAINS = ("six-damiao", "six-robstride", "six-cubemars")
TORQUE, STEPS = 0.1, 0.03
"""RMS of commanded less motor torque of drives with gains, at most: a share of the RMS of the motor torque, and what
the steps of the frames add [N·m]."""
FloatArray = np.ndarray[Any, np.dtype[np.float64]]


class Witness:
    """A socket that gets every datagram of a bus; counts them by sender in a thread of its own."""

    def __init__(self, group: str, port: int) -> None:
        self.senders: Counter[Any] = Counter()
        self._socket = heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        heard.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        heard.bind((group, port))
        heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, struct.pack("4sl", socket.inet_aton(group), 0))
        heard.settimeout(0.2)
        self._ends = False
        self._thread = threading.Thread(target=self._count)
        self._thread.start()

    def _count(self) -> None:
        while not self._ends:
            with contextlib.suppress(TimeoutError):
                self.senders[self._socket.recvfrom(2048)[1]] += 1

    def close(self) -> None:
        self._ends = True
        self._thread.join()
        self._socket.close()


def status_of(path: Path) -> dict[str, Any]:
    """Joints as a daemon on a Unix socket tells them."""
    connection = http.client.HTTPConnection("localhost")
    connection.sock = socket.socket(socket.AF_UNIX)
    connection.sock.connect(str(path))
    connection.request("GET", "/api/status")
    return dict(json.loads(connection.getresponse().read()))


class Bus:
    """One arm, its foreign host and its listeners."""

    def __init__(self, name: str, group: str, port: int, folder: Path) -> None:
        """The arm file with the clients' rate and patience; nothing runs yet."""
        self.name, self.group, self.folder = name, group, folder
        content = yaml.safe_load(bundled_arms()[name].read_text(encoding="utf-8"))
        content["link"] |= {"rate": RATE, "deadline": PATIENCE}
        content["link"]["bus"] |= {"interface": "udp_multicast", "channel": group}
        for joint in content["link"]["joints"]:
            if "can_timeout" in joint["drive"]:
                joint["drive"]["can_timeout"] = LONGEST_TIMEOUT
        self.arm = folder / f"{name}.yaml"
        self.arm.write_text(yaml.safe_dump(content))
        self._environment = os.environ | {"CAN_CONFIG": json.dumps({"port": port})}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self.witness = Witness(group, port)
        self.before: set[Any] = set()
        self.told: dict[str, Any] = {}

    def start(self, name: str, *command: str) -> None:
        log = (self.folder / f"{name}.log").open("wb")
        self._running[name] = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=self._environment)

    def begin(self, seconds: float) -> None:
        """The simulated arm, then the foreign host; returns when both have sent frames."""
        self.start("sim", *ARMLINK, "sim", str(self.arm))
        self._await(lambda: bool((self.folder / "sim.log").read_text()))
        script = str(Path(__file__).with_name("stock_hosts.py"))
        self.start("host", sys.executable, script, str(self.arm), self.name, self.group, "--seconds", str(seconds))
        self._await(lambda: len(self.witness.senders) >= 2)
        self.before = set(self.witness.senders)

    def _await(self, ready: Callable[[], bool]) -> None:
        for _ in range(MOST_STARTS):
            time.sleep(STARTS)
            if ready():
                return

    def listen(self, seconds: float) -> None:
        """The three listeners; they listen for `seconds` and longer."""
        arm, folder = str(self.arm), self.folder
        self.start("record", *ARMLINK, "record", arm, str(folder / "run.mcap"))
        self.start("monitor", *ARMLINK, "monitor", arm, "--cycles", str(int(10 * seconds)), "--json",
                   str(folder / "monitor.json"))  # fmt: skip
        self.start("daemon", *ARMLINK, "daemon", arm, "--listen-only", "--socket", str(folder / "d.sock"), "--state",
                   str(folder / "state"))  # fmt: skip

    def ask(self) -> None:
        """What the daemon has heard."""
        for _ in range(MOST_STARTS):
            with contextlib.suppress(OSError):
                self.told = status_of(self.folder / "d.sock")
                return
            time.sleep(STARTS)

    def end(self) -> None:
        """Listeners first, so that they write their files."""
        for name in ("record", "monitor"):
            if name in self._running:
                self._running[name].send_signal(signal.SIGINT)
                self._running[name].wait(60)
        for each in reversed(self._running.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGTERM)
        for each in self._running.values():
            each.wait(60)
        self.witness.close()

    def judge(self, seconds: float) -> list[str]:
        """What was wrong; empty: nothing."""
        name, senders, wrong = self.name, self.witness.senders, list[str]()
        print(f"{name}: frames by socket: {sorted(senders.values(), reverse=True)}; daemon: {self.told.get('state')}, "
              f"{self.told.get('bus')}", flush=True)  # fmt: skip
        if len(self.before) != 2 or set(senders) != self.before:
            wrong.append(f"{len(senders)} sockets have sent, {len(self.before)} before anybody listened: expected two")
        if not (self.folder / "run.mcap").exists() or not (self.folder / "monitor.json").exists():
            return [*wrong, "record or monitor has written nothing"]
        wrong += judge_recording(name, load_recording(self.folder / "run.mcap"), seconds)
        seen = json.loads((self.folder / "monitor.json").read_text())
        if not all(joint["position"] is not None and math.isfinite(joint["position"]) for joint in seen["joints"]):
            wrong.append("monitor: a joint without a position")
        if not (self.told.get("bus") or {}).get("frames"):
            wrong.append(f"daemon: {self.told.get('state')}: {self.told.get('detail')}")
        return wrong


def judge_recording(name: str, recording: Recording, seconds: float) -> list[str]:
    """What is wrong with the motion and the torque in it."""
    t, position, target = recording.t, recording.position, recording.position_command
    assert position is not None
    assert target is not None
    ways = np.nanmax(target, axis=0) - np.nanmin(target, axis=0)
    moved = np.nanmax(position, axis=0) - np.nanmin(position, axis=0)
    off = np.sqrt(np.nanmean((target - position) ** 2, axis=0))
    periods = np.array([period(t, each) for each in target.T])
    commanded = np.isfinite(target).mean()
    print(f"{name}: recorded {len(t)} rows in {t[-1] - t[0]:.0f} s, {commanded:.1%} with commands; targets swayed "
          f"{ways.round(3).tolist()} rad every {periods.round(2).tolist()} s, joints {moved.round(3).tolist()} rad, "
          f"RMS {off.round(3).tolist()} rad from them", flush=True)  # fmt: skip
    wrong = []
    if t[-1] - t[0] < 0.95 * seconds or commanded < 0.95:
        wrong.append(f"record: {t[-1] - t[0]:.0f} s, commands in {commanded:.1%} of the rows")
    if not np.allclose(ways, SWAY, atol=0.01) or not np.allclose(periods, SECONDS, rtol=0.1):
        wrong.append("record: not the targets that were ordered")
    if not (moved > MOVED).all() or not (off < FOLLOWED).all():
        wrong.append("record: not the motion that was ordered")
    if name in WITH_GAINS:
        wrong += judge_torque(name, recording)
    return wrong


def period(t: FloatArray, values: FloatArray) -> float:
    """Median time from one rise through the mean to the next [s]."""
    there = np.isfinite(values)
    above = values[there] > values[there].mean()
    return float(np.median(np.diff(t[there][1:][above[1:] & ~above[:-1]])))


def judge_torque(name: str, recording: Recording) -> list[str]:
    """Whether what the drives told of their torque is what the recorded commands ask for.

    A reply tells the torque that the command before it makes where the drive now is: by the client's own gains.
    """
    q, dq, command, motor = recording.position, recording.velocity, recording.torque_command, recording.motor_torque
    assert q is not None
    assert dq is not None
    assert command is not None
    assert motor is not None
    kp, kd = np.array([gains(joint) for joint in range(q.shape[1])]).T
    made = command[:-1] + kp * (q[:-1] - q[1:]) + kd * (dq[:-1] - dq[1:])
    off = np.sqrt(np.nanmean((made - motor[1:]) ** 2, axis=0))
    whole = np.sqrt(np.nanmean(motor**2, axis=0))
    print(f"{name}: commanded less motor torque: RMS {off.round(3).tolist()} of {whole.round(3).tolist()} N·m",
          flush=True)  # fmt: skip
    return [] if (off < TORQUE * whole + STEPS).all() else ["record: not the torque that the commands ask for"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--arm", nargs="*", default=list(HOSTS))
    parser.add_argument("--group", default="239.74.163.77")
    asked = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        buses = []
        for place, arm in enumerate(asked.arm):
            folder = Path(name) / arm
            folder.mkdir()
            buses.append(Bus(arm, asked.group, PORT + place, folder))
            stack.callback(buses[-1].end)
            buses[-1].begin(asked.seconds + 60 * STARTS)
        for bus in buses:
            bus.listen(asked.seconds)
        time.sleep(asked.seconds + 5 * STARTS)
        for bus in buses:
            bus.ask()
        stack.close()
        for bus in buses:
            wrong = bus.judge(asked.seconds)
            for text in wrong:
                print(f"{bus.name}: {text}", flush=True)
            if wrong:
                for log in sorted(bus.folder.glob("*.log")):
                    print(f"--- {log.name}: {log.read_text(errors='replace')[-800:]}", flush=True)
            failed += bool(wrong)
            print(f"{bus.name}: {'wrong' if wrong else 'no frame sent'} in {asked.seconds:g} s", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
