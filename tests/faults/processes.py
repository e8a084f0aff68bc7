"""A simulated arm and a host in processes of their own, and an ear on their bus: what kills and stops are tried on."""

import contextlib
import json
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
from rows import ARM

from armlink.arm_file import parse_arm
from armlink.drives.canopen.cia402 import DriveState, state_of

ROOT = Path(__file__).parent.parent.parent
ARMLINK = [sys.executable, "-c", "from armlink.cli import main; main()"]
NODES = (11, 12, 13)
STATUS_READ = bytes.fromhex("4b416000")
"""How the answer to an SDO upload of 6041h begins."""
HOST = """
import sys
from armlink.arm_file import load_arm
from armlink.errors import ArmlinkError
from armlink.link.link import Link
from armlink.link.types import Command
sys.path.insert(0, "tests/faults")
from patient_start import start
try:
    with Link.open(load_arm(sys.argv[1]), sys.argv[2]) as link:
        start(link)
        command = Command.hold(link.enable().position)
        command.mode[0], command.torque[0] = 10, 2.0
        for cycle in range(1_000_000):
            link.cycle(command)
            if cycle == int(0.3 * link.rate):
                print("pushing", flush=True)
except ArmlinkError as error:
    print(error, flush=True)
    sys.exit(error.exit_status)
"""


def write_arm(folder: Path, rate: float, deadline: float, device: str = "") -> Path:
    """The fault tests' arm, slow enough for several processes on one core; `device` as in the key `sim.device`."""
    content: dict[str, Any] = {**ARM, "link": {**ARM["link"], "rate": rate, "deadline": deadline}}
    if device:
        content["sim"] = {**ARM["sim"], "device": device}
        rows = [dict(row) for row in ARM["link"]["joints"]]
        content["link"]["joints"] = [
            row | {"drive": {"family": "canopen", "node": row.pop("node"), "torque": "motor"}} for row in rows
        ]
    path = folder / "triple.yaml"
    parse_arm(content, path)
    path.write_text(json.dumps(content))
    return path


@contextlib.contextmanager
def simulated(arm: Path, bus: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`armlink sim` on `bus`; ready when entered."""
    command = [*ARMLINK, "sim", str(arm), "--bus", bus, *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            assert "nodes 11, 12, 13" in line, line
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=60)


def start_host(arm: Path, bus: str) -> subprocess.Popen[str]:
    """A host that holds two joints and pushes the first; it says "pushing" when it does."""
    return subprocess.Popen([sys.executable, "-c", HOST, str(arm), bus], stdout=subprocess.PIPE, text=True, cwd=ROOT)


class Ear:
    """Listens to the joints' states and torques, with the time at which each frame came."""

    def __init__(self, bus: str) -> None:
        interface, _, channel = bus.partition(":")
        filters = [{"can_id": base, "can_mask": 0x780, "extended": False} for base in (0x280, 0x380, 0x580)]
        self.bus = can.Bus(channel, interface=interface, can_filters=filters)
        self.states: dict[int, DriveState] = {}
        self.when: dict[int, float] = {}
        """When each joint came into its state, by time.monotonic() [s]."""

    def listen(self, done: Callable[[dict[int, DriveState]], bool], seconds: float) -> bool:
        """Take frames in until `done(states)`, or the time is over."""
        end = time.monotonic() + seconds
        while not done(self.states):
            message = self._next(max(0.0, min(0.1, end - time.monotonic())))
            if message is not None:
                self._hear(message.arbitration_id & 0x7F, message.arbitration_id & 0x780, bytes(message.data))
            elif time.monotonic() >= end:
                return False
        return True

    def _next(self, timeout: float) -> can.Message | None:
        try:
            return self.bus.recv(timeout)
        except can.CanError:  # the interface is, or was, down
            return None

    def _hear(self, node: int, service: int, data: bytes) -> None:
        if service == 0x580:
            if data[:4] != STATUS_READ:
                return
            data = data[4:]
        state = state_of(struct.unpack_from("<H", data)[0])
        if self.states.get(node) is not state:
            self.states[node], self.when[node] = state, time.monotonic()

    def ask(self) -> None:
        """Ask every node for its status word: what changed while it was cut off, nobody heard."""
        for node in NODES:
            request = b"\x40" + STATUS_READ[1:] + bytes(4)
            self.bus.send(can.Message(arbitration_id=0x600 + node, data=request, is_extended_id=False))

    def see(self, done: Callable[[dict[int, DriveState]], bool]) -> bool:
        """Ask until `done(states)`; what came so far, and may have been too much to keep, does not count."""
        self.forget()
        for _ in range(5):
            self.ask()
            if self.listen(done, 1.0):
                return True
        return False

    def forget(self) -> None:
        """Drop what came so far."""
        while self._next(0.0) is not None:
            pass
        self.states.clear()


def all_are(*wanted: DriveState) -> Callable[[dict[int, DriveState]], bool]:
    """Whether every joint is in one of the states wanted."""
    return lambda states: all(states.get(node) in wanted for node in NODES)


SAFE = all_are(DriveState.QUICK_STOP, DriveState.SWITCH_ON_DISABLED)
ENABLED = all_are(DriveState.ENABLED)
