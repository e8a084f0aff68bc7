"""Attacks on a real SocketCAN bus: a host that moves an arm, perhaps behind a guard, and what others do to it there.

Everything runs in processes of its own: the arm (on vcan0), its guard (vcan1 for the host, vcan0 for itself), the host,
and whoever attacks. An attack is judged by how the joints truly moved.
"""

import contextlib
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import can
from processes import ARMLINK, ROOT
from witnessed_arm import Motion, Witness, witnessed

from armlink.guard import bus_guard

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink"))

from vcan_pair import pair_text

DEADLINE = 0.3
"""Of the arm [s]."""
AMPLITUDE, OMEGA = 0.4, 1.0
"""Of the host's motion [rad], [rad/s]: its fastest is their product."""
EXCESS, STILL = 1.0, 0.02
"""No joint may be this much faster than its motion [rad/s]; one that holds is slower than this [rad/s]."""
STARTS = 4
"""A host on a busy machine may be late while it starts."""
AFTERWARDS = 1.2
"""Time after an attack until the joints must hold [s]: the deadline, the stop, and what a busy machine adds."""
FLOOD_RATE, FLOOD_SECONDS = 20_000, 1.0
ARM = pair_text(DEADLINE, 1.0, 1.0)
HOST = f"""
import sys
import numpy as np
from armlink.arm_file import load_arm
from armlink.errors import ArmlinkError
from armlink.link.link import Link
from armlink.link.types import Command
sys.path.insert(0, "tests/faults")
from patient_start import start
try:
    with Link.open(load_arm(sys.argv[1])) as link:
        start(link)
        origin = link.enable().position
        side = -np.sign(origin)
        for cycle in range(1_000_000):
            link.cycle(Command.hold(origin + side * {AMPLITUDE} * np.sin({OMEGA} * cycle * link.period)))
            if cycle == 20:
                print("moving", flush=True)
except ArmlinkError as error:
    print(type(error).__name__, error, flush=True)
"""


@dataclass
class Outcome:
    """What an attack did."""

    host: str
    """What the host said in the end; empty where it goes on."""
    guard: str
    """What the guard said, a line each; empty without one."""
    motion: Motion
    """From the attack until the end."""
    last: Motion
    """At the end."""
    others: list[str] = field(default_factory=list)
    """What others said."""

    @property
    def wrong(self) -> str:
        """What is not as it should be; empty if nothing is."""
        if self.motion.fastest > AMPLITUDE * OMEGA + EXCESS:
            return f"{self.motion.fastest:.2f} rad/s"
        if self.host and self.last.fastest > STILL:
            return f"the host has ended and the joints turn at {self.last.fastest:.2f} rad/s"
        if not self.host and not self.last.powered:
            return "the joints have no power and the host goes on"
        return ""


class Scene:
    """The arm, and where an attack takes place."""

    def __init__(self, folder: Path, witness: Witness) -> None:
        self.folder, self.witness = folder, witness
        self.arm, self.policy = folder / "pair.yaml", folder / "pair.guard.json"
        self.inside = folder / "inside.yaml"
        self.inside.write_text(ARM.replace("vcan0", "vcan1"))

    def write_policy(self) -> None:
        """As `armlink guard` does."""
        done = subprocess.run(
            [*ARMLINK, "guard", str(self.arm), "--out", str(self.policy)], capture_output=True, text=True, cwd=ROOT
        )
        assert done.returncode == 0, done.stderr

    def start_guard(self, policy: Path | None = None) -> subprocess.Popen[str]:
        """A guard that has said that it is there."""
        command = [sys.executable, "-I", bus_guard.__file__, str(policy or self.policy), "vcan1", "vcan0"]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        assert "vcan1 may command vcan0" in process.stderr.readline()
        return process

    def started(self, guarded: bool) -> tuple[subprocess.Popen[str] | None, subprocess.Popen[str]]:
        """Guard, if any, and a host that moves the arm: one that this machine was too late for begins again."""
        said = ""
        for _ in range(STARTS):
            guard = self.start_guard() if guarded else None
            host = subprocess.Popen(
                [sys.executable, "-c", HOST, str(self.inside if guarded else self.arm)],
                stdout=subprocess.PIPE,
                text=True,
                cwd=ROOT,
            )
            assert host.stdout is not None
            said = host.stdout.readline()
            if said == "moving\n":
                return guard, host
            for each in (host, guard):
                if each is not None:
                    each.terminate()
                    each.communicate(timeout=30)
        raise AssertionError(f"the host does not move the arm in {STARTS} starts: {said}")

    def attack(self, attack: "Attack", guarded: bool, delay: float = 0.0) -> Outcome:
        """Let a host move the arm, and attack `delay` [s] after it has begun to."""
        guard, host = self.started(guarded)
        under = Attacked(self, host, guard)
        assert host.stdout is not None
        try:
            time.sleep(delay)
            began = time.monotonic()
            attack(under)
            time.sleep(AFTERWARDS)
            ended = time.monotonic()
            time.sleep(0.5)
            ran = host.poll() is None
        finally:
            host.kill()
            processes = [each for each in (guard, *under.started) if each is not None]
            for each in processes:
                each.send_signal(signal.SIGCONT)
                each.terminate()
        said = host.stdout.read().strip()
        told = ["" if each.stderr is None else each.communicate(timeout=30)[1].strip() for each in processes]
        assert ran or said
        motion, last = self.witness.motion(began, ended), self.witness.motion(ended - 0.3, ended + 0.4)
        return Outcome(said, told[0] if guarded else "", motion, last, told[1:] if guarded else told)


@dataclass
class Attacked:
    """What an attack may lay hands on."""

    scene: Scene
    host: subprocess.Popen[str]
    guard: subprocess.Popen[str] | None
    started: list[subprocess.Popen[str]] = field(default_factory=list)
    """Processes that the attack started."""


Attack = Callable[[Attacked], None]


@contextlib.contextmanager
def scene(folder: Path) -> Iterator[Scene]:
    """The arm on vcan0, and the policy of its guard; ready when entered."""
    arm = folder / "pair.yaml"
    arm.write_text(ARM)
    with witnessed(arm, "socketcan:vcan0", folder / "report.jsonl") as witness:
        built = Scene(folder, witness)
        built.write_policy()
        yield built


# ---- attacks


def frame(can_id: int, data: bytes = b"", **how: bool) -> can.Message:
    """A frame with 11 bits of identifier."""
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=how.pop("extended", False), **how)


FRAMES = {
    "high priority": frame(0x001, bytes(8)),
    "low priority": frame(0x7FF, bytes(8)),
    "readings of a drive": frame(0x18B, bytes(8)),
    "remote": can.Message(arbitration_id=0x18B, dlc=8, is_remote_frame=True, is_extended_id=False),
    "extended": frame(0x1FFFFFFF, bytes(8), extended=True),
    "CAN FD": frame(0x18B, bytes(48), is_fd=True),
    "error": can.Message(arbitration_id=0x004, data=bytes(8), is_error_frame=True),
    "bus-off": can.Message(arbitration_id=0x040, data=bytes(8), is_error_frame=True),
}
"""What the bus is flooded with; an error frame's identifier is its class (controller, bus-off)."""


def flood(channel: str, kind: str, seconds: float = FLOOD_SECONDS) -> Attack:
    """FLOOD_RATE frames a second, as far as the machine can."""

    def attack(under: Attacked) -> None:
        message = FRAMES[kind] if kind in FRAMES else frame(0x080)
        with can.Bus(channel, interface="socketcan", fd=message.is_fd) as bus:
            began, sent = time.monotonic(), 0
            while (passed := time.monotonic() - began) < seconds:
                while sent < FLOOD_RATE * passed:
                    bus.send(message)
                    sent += 1
                time.sleep(0.001)

    return attack


def send(channel: str, message: can.Message) -> Attack:
    """One frame."""

    def attack(under: Attacked) -> None:
        with can.Bus(channel, interface="socketcan", fd=message.is_fd) as bus:
            bus.send(message)

    return attack


def signalled(number: int, then: float = 0.0) -> Attack:
    """The guard gets a signal, and SIGCONT `then` seconds later."""

    def attack(under: Attacked) -> None:
        assert under.guard is not None
        under.guard.send_signal(number)
        if then:
            time.sleep(then)
            under.guard.send_signal(signal.SIGCONT)

    return attack


def host_stopped(seconds: float) -> Attack:
    """The host does not read for a while, and its receive queue runs over if enough comes."""

    def attack(under: Attacked) -> None:
        under.host.send_signal(signal.SIGSTOP)
        flood("vcan0", "low priority", seconds)(under)
        under.host.send_signal(signal.SIGCONT)

    return attack


def guard_again(pause: float) -> Attack:
    """The guard is killed, and another takes its place while the host lives."""

    def attack(under: Attacked) -> None:
        assert under.guard is not None
        under.guard.kill()
        under.guard.wait()
        time.sleep(pause)
        under.started.append(under.scene.start_guard())

    return attack


def second_guard(under: Attacked) -> None:
    """Another guard between the same interfaces."""
    under.started.append(under.scene.start_guard())


def link(channel: str, *steps: str) -> Attack:
    """`ip link` does this to an interface, step by step."""

    def attack(under: Attacked) -> None:
        for step in steps:
            words = ("add", "dev", channel, *step.split()[1:]) if step.startswith("add") else (*step.split(), channel)
            if step in ("up", "down"):
                words = ("set", channel, step)
            subprocess.run(["ip", "link", *words], check=True)
            time.sleep(0.5)

    return attack


COMMAND = struct.Struct("<Hhi")
GUARDED: dict[str, Attack] = {
    "killed": signalled(signal.SIGKILL),
    "ended": signalled(signal.SIGTERM),
    "its terminal is closed": signalled(signal.SIGHUP),
    "Ctrl-\\": signalled(signal.SIGQUIT),
    "Ctrl-Z": signalled(signal.SIGTSTP),
    "suspended for less than the deadline": signalled(signal.SIGSTOP, 0.2),
    "suspended": signalled(signal.SIGSTOP, 1.0),
    "killed and started again at once": guard_again(0.0),
    "killed and started again": guard_again(1.0),
    "a second guard": second_guard,
    "flood of the wire": flood("vcan0", "high priority"),
    "flood of readings": flood("vcan0", "readings of a drive"),
    "flood of SYNCs by a program": flood("vcan1", "SYNC"),
    "flood of readings by a program": flood("vcan1", "readings of a drive"),
    "flood of remote frames by a program": flood("vcan1", "remote"),
    "SYNC as CAN FD by a program": send("vcan1", frame(0x080, is_fd=True)),
    "position by a program": send("vcan1", frame(0x20B, COMMAND.pack(15, 0, 400_000))),
    "command on the wire": send("vcan0", frame(0x20B, COMMAND.pack(15, 0, 100_000))),
    "wire down and up": link("vcan0", "down", "up"),
    "program's interface down and up": link("vcan1", "down", "up"),
}
"""Attacks on an arm whose host is behind a guard."""
BARE: dict[str, Attack] = {
    **{f"flood: {kind}": flood("vcan0", kind) for kind in FRAMES},
    "flood while the host does not read": host_stopped(1.0),
    "interface down and up": link("vcan0", "down", "up"),
}
"""Attacks on an arm whose host has the wire for itself."""
