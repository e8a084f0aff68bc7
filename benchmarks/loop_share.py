"""Share of a core that the process takes which keeps an arm's cycle, on this machine's own kernel.

    .venv/bin/python benchmarks/loop_share.py [--arm openarm] [--rate 250] [--seconds 30] [--bus BUS] [--bitrate 1e6]

The loop is that of every job (`armlink.loop.process`), started by a `RemoteLink` that plays a slow motion; the arm is
simulated in a process of its own. Without `--bus` the two are joined by a pair of Unix sockets that carry the 16 bytes
of SocketCAN's `can_frame`, read and written by the link's own SocketCAN port, with a process between them that lets
every frame take its time on the wire: replies come one by one, as from a real bus. `--bus udp_multicast:239.74.163.57`
or `socketcan:vcan0` put both on that bus. Where the machine has two cores or more, the loop has the last for itself and
simulated arm, wire and job share the others: beside a real arm they do not push the loop out of its caches either
(`--together` leaves it to the kernel). Prints JSON; processor time is what the kernel counts of the loop's threads.
"""

import argparse
import heapq
import json
import multiprocessing
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from armlink.arm_file import ArmFile, bundled_arms, load_arm
from armlink.bus.frame_bits import frame_bits
from armlink.bus.port import Port
from armlink.bus.sockets.datagram_port import SocketPort
from armlink.link.link import Link
from armlink.link.types import Setpoints
from armlink.loop import cycle_process, process
from armlink.loop.realtime import SIMULATED_PRIORITY, prepare
from armlink.loop.remote_link import RemoteLink

SWAY, TURN = 0.05, 4.0
"""Motion of every joint [rad] and time for it and back [s]."""
DEADLINE = 1.0
"""Of the drives [s]: the machine may be busy."""


class PairBus:
    """One end of a pair of sockets as a bus of CAN frames; a CanBus."""

    clock = None
    channel_info = "pair of sockets"
    fd = False

    def __init__(self, end: socket.socket) -> None:
        """Take over the socket."""
        self.end = end

    def open_port(self, as_node: bool = False) -> Port:
        """SocketCAN's own."""
        return SocketPort(self.end, self.channel_info, as_node=as_node)

    def open_listening_port(self) -> Port:
        """Nobody listens."""
        raise NotImplementedError

    def shutdown(self) -> None:
        """Close this end."""
        self.end.close()


def carry(one: socket.socket, other: socket.socket, bit: float) -> None:
    """The wire between two sockets: one frame at a time, the lowest identifier first; a bit takes `bit` [s]."""
    prepare(SIMULATED_PRIORITY)
    ends, waiting, free, number = {one: other, other: one}, list[tuple[int, int, bytes, socket.socket]](), 0.0, 0
    while True:
        for end in select.select(list(ends), [], [], 0.0 if waiting else None)[0]:
            frame = end.recv(64)
            if not frame:
                return
            number += 1
            heapq.heappush(waiting, (int.from_bytes(frame[:4], "little"), number, frame, ends[end]))
        if waiting:
            can_id, _, frame, to = heapq.heappop(waiting)
            now = time.monotonic()
            free = max(free, now - bit * 130) + bit * frame_bits(can_id, frame[8 : 8 + frame[4]])
            if free > now:
                time.sleep(free - now)
            to.send(frame)


def seven_joints(name: str, rate: float, folder: Path) -> Path:
    """The bundled arm at this rate."""
    content = yaml.safe_load(bundled_arms()[name].read_text(encoding="utf-8"))
    content["serial"] = "SIM-BENCH"  # no record of another is for it
    content["link"] |= {"rate": rate, "deadline": DEADLINE}
    model = content["kinematics"].get("model")
    if model:
        content["kinematics"]["model"] = str(bundled_arms()[name].with_name(model))
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def simulate(path: str, number: int) -> None:
    """The simulated arm at its end of the pair, until that closes."""
    from armlink.errors import BusFault
    from sim_bus.bus.server import ArmServer
    from sim_bus.simulated_arm import SimulatedArm
    from sim_bus.truth import Truth

    arm = load_arm(path)
    bus = PairBus(socket.socket(fileno=number))  # keeps the socket open
    server = ArmServer(SimulatedArm(arm, Truth.of(arm)), bus)
    prepare(SIMULATED_PRIORITY)
    print("ready", flush=True)
    try:
        server.run()
    except BusFault:
        return


def keep_cycle(number: int, pair: int) -> None:
    """`armlink.loop.process` with the pair for a bus."""
    Link.open = classmethod(  # type: ignore[assignment, method-assign]
        lambda kind, arm, bus: kind(arm, PairBus(socket.socket(fileno=pair)))
    )
    process.main(number)


def start_arm(path: Path, bus: str, pair: int) -> "subprocess.Popen[str]":
    """The arm's process; it is ready when this returns."""
    if bus:
        command = [sys.executable, "-m", "armlink.cli", "sim", str(path), "--bus", bus]
        arm = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert arm.stderr is not None
        arm.stderr.readline()
    else:
        command = [sys.executable, __file__, "--simulate", str(path), str(pair)]
        arm = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, pass_fds=[pair])
        assert arm.stdout is not None
        arm.stdout.readline()
    return arm


def on_pair(pair: int) -> None:
    """Let every RemoteLink of this process start its loop with the pair for a bus."""

    def started(command: list[str], pass_fds: list[int], **other: Any) -> "subprocess.Popen[bytes]":
        own = [sys.executable, __file__, "--keep-cycle", command[-1], str(pair)]
        return subprocess.Popen(own, pass_fds=[*pass_fds, pair], **other)

    names = {"Popen": started, "DEVNULL": subprocess.DEVNULL}
    cycle_process.subprocess = SimpleNamespace(**names)  # type: ignore[assignment]


def processor_time(pid: int) -> float:
    """Time that all threads of a process have run [s]."""
    runs = [int(path.read_text().split()[0]) for path in Path(f"/proc/{pid}/task").glob("*/schedstat")]
    return sum(runs) * 1e-9


def wakes(pid: int) -> int:
    """How often its main thread has waited."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])


def measure(arm: ArmFile, bus: str, seconds: float, core: int | None) -> dict[str, Any]:
    """The figures of one run, the loop on this core if one is given."""
    with RemoteLink(arm, bus or None) as link:
        if core is not None:
            os.sched_setaffinity(link.pid, {core})
        link.start()
        start = link.enable().position
        t = np.arange(int((seconds + 2.0) * link.rate)) / link.rate
        position = start + SWAY / 2 * (1 - np.cos(2 * np.pi * t / TURN))[:, None]
        samples = link.play(Setpoints.follow(position))
        for _ in range(int(2.0 * link.rate)):
            next(samples)
        missed, woken = link.stats.missed, wakes(link.pid)
        began, used = time.monotonic(), processor_time(link.pid)
        ages = np.array([sample.age.max() for sample in samples])
        elapsed, used = time.monotonic() - began, processor_time(link.pid) - used
        answer = {
            "arm": arm.name,
            "joints": link.n,
            "rate_hz": len(ages) / elapsed,
            "loop_core_share": used / elapsed,
            "loop_us_per_cycle": used / len(ages) * 1e6,
            "wakes_per_cycle": (wakes(link.pid) - woken) / len(ages),
            "bus_load": link.stats.load,
            "missed": link.stats.missed - missed,
            "oldest_reading_ms": ages.max() * 1e3,
            "bus": bus or "can_frame over a pair of sockets",
        }
        link.disable()
    return answer


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="openarm")
    parser.add_argument("--rate", type=float, default=250.0)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--bus", default="")
    parser.add_argument("--bitrate", type=float, default=1e6, help="of the wire between the pair [bit/s]")
    parser.add_argument("--together", action="store_true", help="let the kernel choose every process's core")
    parser.add_argument("--simulate", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--keep-cycle", nargs=2, type=int, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.simulate:
        simulate(asked.simulate[0], int(asked.simulate[1]))
        return 0
    if asked.keep_cycle:
        keep_cycle(*asked.keep_cycle)
        return 0
    *others, last = sorted(os.sched_getaffinity(0))
    core = last if others and not asked.together else None
    if core is not None:
        os.sched_setaffinity(0, others)
    os.environ["CAN_CONFIG"] = json.dumps({"port": 44200 + os.getpid() % 1000})
    ours, near = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    far, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    wire = multiprocessing.get_context("fork").Process(target=carry, args=(near, far, 1 / asked.bitrate), daemon=True)
    if not asked.bus:
        on_pair(ours.fileno())
        wire.start()
    with tempfile.TemporaryDirectory() as folder:
        path = seven_joints(asked.arm, asked.rate, Path(folder))
        arm = start_arm(path, asked.bus, theirs.fileno())
        theirs.close()
        try:
            print(json.dumps(measure(load_arm(str(path)), asked.bus, asked.seconds, core), indent=1))
        finally:
            arm.terminate()
            arm.wait()
            if not asked.bus:
                wire.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
