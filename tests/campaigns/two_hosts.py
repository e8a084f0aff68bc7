"""Listening beside another host in real time: record, monitor and daemon --listen-only send no frame.

`two_hosts.py [--seconds 600] [--arm six-damiao …] [--group 239.74.163.77]`; a simulated arm in one process, its host in
another (which sways all joints), the three listeners at once, all on one udp_multicast bus. A witness counts the frames
by the socket that sent them. Exit status 0 where only two sockets have sent, the arm's and its host's, and every
listener saw the joints move.
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
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import load_arm
from armlink.errors import BusFault, Refused
from armlink.link.link import Link
from armlink.link.park import straight
from armlink.link.types import Command
from armlink.recording.files import load_recording

ARMLINK = [sys.executable, "-m", "armlink.cli"]
PORT = 43113
"""Of python-can's udp_multicast."""
STARTS = 6.0
"""Time for each process to begin [s]."""
MOST_STARTS = 10
"""A busy machine may take so many times as long to begin."""
SWAY, SPEED = 0.25, 0.5
"""Of the other host's motion [rad], [rad/s]."""
PATIENCE, AGAIN = 1.0, 0.5
"""Deadline of the other host's drives [s], and how long it waits before it tries again [s]."""
MOVED = 0.2
"""A listener must have seen every joint move so far [rad]."""


def host(arm_name: str, bus: str, seconds: float) -> None:
    """The other host: sways all joints about where they stand; on a busy machine it begins again where it stalled."""
    arm = load_arm(arm_name)
    arm = arm.model_copy(update={"link": arm.require_link().model_copy(update={"deadline": PATIENCE})})
    with Link.open(arm, bus) as link:
        end = time.monotonic() + seconds
        begun(link.start, end)
        begun(link.enable, end)
        start, side = link.position_sent, 1.0
        while time.monotonic() < end:
            goal = start + side * SWAY * np.where(start > 0, -1.0, 1.0)
            try:
                for target in straight(link.position_sent, goal, np.full(link.n, SPEED), link.period):
                    link.cycle(Command.hold(target))
            except (BusFault, Refused) as fault:
                print(f"other host: {fault}", flush=True)
                begun(link.recover, end)
            side = 0.0 if side else 1.0


def begun(step: Callable[[], object], end: float) -> None:
    """Do a step of the other host again until it succeeds; raises its error where it has not until `end` [s]."""
    while True:
        try:
            step()
            return
        except (BusFault, Refused) as fault:
            if time.monotonic() > end:
                raise
            print(f"other host: {fault}", flush=True)
            time.sleep(AGAIN)


def witness(group: str) -> socket.socket:
    """A socket that gets every datagram of the bus."""
    heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    heard.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    heard.bind((group, PORT))
    heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, struct.pack("4sl", socket.inet_aton(group), 0))
    heard.settimeout(0.2)
    return heard


def status_of(path: Path) -> dict[str, Any]:
    """Joints as a daemon on a Unix socket tells them."""
    connection = http.client.HTTPConnection("localhost")
    connection.sock = socket.socket(socket.AF_UNIX)
    connection.sock.connect(str(path))
    connection.request("GET", "/api/status")
    return dict(json.loads(connection.getresponse().read()))


def one(arm: str, group: str, seconds: float, folder: Path) -> list[str]:
    """What was wrong; empty: nothing."""
    bus, running, senders = f"udp_multicast:{group}", list[subprocess.Popen[bytes]](), Counter[Any]()
    heard = witness(group)

    def start(name: str, *command: str) -> subprocess.Popen[bytes]:
        running.append(subprocess.Popen(command, stdout=(folder / f"{name}.log").open("wb"), stderr=subprocess.STDOUT))
        return running[-1]

    def count(duration: float) -> None:
        end = time.monotonic() + duration
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                senders[heard.recvfrom(2048)[1]] += 1

    wrong, told = list[str](), dict[str, Any]()
    try:
        start("sim", *ARMLINK, "sim", arm, "--bus", bus)
        count(STARTS)
        start("host", sys.executable, __file__, "--host", arm, "--bus", bus, "--seconds", str(seconds + 10 * STARTS))
        for _ in range(MOST_STARTS):
            if len(senders) == 2:
                break
            count(STARTS)
        before = set(senders)
        recorder = start("record", *ARMLINK, "record", arm, str(folder / "run.mcap"), "--bus", bus, "--seconds",
                         str(seconds))  # fmt: skip
        monitor = start("monitor", *ARMLINK, "monitor", arm, "--bus", bus, "--cycles", str(int(5 * seconds)), "--json",
                        str(folder / "monitor.json"))  # fmt: skip
        start("daemon", *ARMLINK, "daemon", arm, "--bus", bus, "--listen-only", "--socket", str(folder / "d.sock"),
              "--state", str(folder / "state"))  # fmt: skip
        count(seconds)
        try:
            told = status_of(folder / "d.sock")
        except OSError as error:
            wrong.append(f"daemon: {error}")
        count(2 * STARTS)
        for each in (recorder, monitor):
            each.send_signal(signal.SIGINT)
            each.wait(60)
    finally:
        for each in reversed(running):
            with contextlib.suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGTERM)
        for each in running:
            each.wait(60)
        heard.close()
    print(f"{arm}: frames by socket: {sorted(senders.values(), reverse=True)}; daemon: {told.get('state')}, "
          f"{told.get('bus')}", flush=True)  # fmt: skip
    if len(before) != 2 or set(senders) != before:
        wrong.append(f"{len(senders)} sockets have sent, {len(before)} before anybody listened: expected two")
    recording = load_recording(folder / "run.mcap")
    ways = np.nanmax(recording.position, axis=0) - np.nanmin(recording.position, axis=0)
    commanded = np.isfinite(recording.position_command).mean() if recording.position_command is not None else 0.0
    print(f"{arm}: recorded {len(recording.t)} rows, joints moved {ways.round(2).tolist()} rad, "
          f"{commanded:.0%} of the rows with commands", flush=True)  # fmt: skip
    if not (ways > MOVED).all() or commanded < 0.9:
        wrong.append(f"record: joints moved by {ways.round(2).tolist()} rad, commands in {commanded:.0%} of the rows")
    seen = json.loads((folder / "monitor.json").read_text())
    if not all(joint["position"] is not None and math.isfinite(joint["position"]) for joint in seen["joints"]):
        wrong.append("monitor: a joint without a position")
    if not (told.get("bus") or {}).get("frames"):
        wrong.append(f"daemon: {told.get('state')}: {told.get('detail')}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--arm", nargs="*", default=["six-damiao", "six-robstride", "six-odrive", "six-cia402"])
    parser.add_argument("--group", default="239.74.163.77")
    parser.add_argument("--host", default="")
    parser.add_argument("--bus", default="")
    asked = parser.parse_args()
    if asked.host:
        host(asked.host, asked.bus, asked.seconds)
        return 0
    failed = 0
    for arm in asked.arm:
        with tempfile.TemporaryDirectory() as folder:
            wrong = one(arm, asked.group, asked.seconds, Path(folder))
            for text in wrong:
                print(f"{arm}: {text}", flush=True)
            if wrong:
                for log in sorted(Path(folder).glob("*.log")):
                    print(f"--- {log.name}: {log.read_text(errors='replace')[-400:]}", flush=True)
            failed += bool(wrong)
            print(f"{arm}: {'wrong' if wrong else 'no frame sent'} in {asked.seconds:g} s", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
