"""One host's cycle of seven joints on SocketCAN: the link against canopen's RemoteNode and PDO variables, run in turn.

A cycle is seven RPDOs (control word, target torque, target position), SYNC, seven TPDOs (position, torque) decoded. The
link's cycle is `Link.cycle` whole: gate and fault detection are in it, which the peer does not have. Both go as fast as
they can. Prints JSON: a list of {"ours": {...}, "peer": {...}}, one a run, with cycles a second and CPU microseconds a
frame; what the kernel does for a sender is in its CPU time, and the same on both sides.
"""

import json
import subprocess
import sys
import threading
import time

import canopen
from echo_nodes import NODES, answer_in_kernel, make_arm, remove_gateway, start_nodes

from armlink.bus.open import open_bus
from armlink.clock import MonotonicClock
from armlink.drives.canopen.eds_file import bundled
from armlink.link.link import Link
from armlink.link.types import Command

FRAMES = 2 * len(NODES) + 1


class NoPause(MonotonicClock):
    """The machine's clock, for a host that cycles without pause."""

    def sleep_until(self, instant: float) -> None:
        """Return at once."""


class OurHost:
    """The link, started and enabled on the nodes."""

    def __init__(self, channel: str) -> None:
        bus = {"interface": "socketcan", "channel": channel}
        arm = make_arm(len(NODES), link={"bus": bus, "rate": 50, "deadline": 10.0})
        self.link = Link(arm, open_bus(None, arm.require_link().bus), NoPause())
        self.link.start()
        self.command = Command.hold(self.link.enable().position)

    def cycles(self, count: int) -> None:
        """Run `count` cycles; every reading must arrive."""
        missed = self.link.stats.missed
        for _ in range(count):
            sample = self.link.cycle(self.command)
        assert self.link.stats.missed == missed, "a reading was missed"
        assert abs(sample.torque[-1] - 2.000007) < 1e-9


class PeerHost:
    """canopen: its notifier thread receives, its PDO variables are set and read."""

    def __init__(self, channel: str) -> None:
        self.network = canopen.Network()
        self.network.connect(interface="socketcan", channel=channel)
        dictionary = bundled()
        self.came, self.missing = threading.Event(), 0
        self.commands, self.readings = [], []
        for number in NODES:
            node = canopen.RemoteNode(number, dictionary)
            self.network.add_node(node)
            rpdo, tpdo = node.rpdo[1], node.tpdo[1]
            rpdo.clear(), tpdo.clear()
            self.commands.append((rpdo, [rpdo.add_variable(index) for index in (0x6040, 0x6071, 0x607A)]))
            position, torque = tpdo.add_variable(0x6064), tpdo.add_variable(0x2100, 1)
            rpdo.cob_id, tpdo.cob_id = 0x200 + number, 0x180 + number
            rpdo.enabled = tpdo.enabled = True
            tpdo.add_callback(self._take)
            tpdo.subscribe()
            self.readings.append((position, torque))

    def _take(self, pdo: object) -> None:
        self.missing -= 1
        if not self.missing:
            self.came.set()

    def cycles(self, count: int) -> None:
        """Run `count` cycles; every reading must arrive."""
        for _ in range(count):
            self.came.clear()
            self.missing = len(NODES)
            for rpdo, (control, torque, position) in self.commands:
                control.raw, torque.raw, position.raw = 15, 0, 1000
                rpdo.transmit()
            self.network.sync.transmit()
            assert self.came.wait(1.0), "a reading was missed"
            values = [(position.raw, torque.raw) for position, torque in self.readings]
        assert values[-1][1] == 2_000_007


def run(kind: str, channel: str, seconds: float) -> dict[str, float]:
    """Cycles per second and CPU per frame [µs] of one host in this process, over `seconds`."""
    nodes = start_nodes(channel)
    host = {"ours": OurHost, "peer": PeerHost}[kind](channel)
    kernel = answer_in_kernel(channel)
    try:
        start = time.perf_counter()
        host.cycles(50)
        count = max(50, int(50 * seconds / (time.perf_counter() - start)))
        start, cpu = time.perf_counter(), time.process_time()
        host.cycles(count)
        elapsed, cpu = time.perf_counter() - start, time.process_time() - cpu
    finally:
        if kernel:
            remove_gateway()
        nodes.terminate()
        nodes.join()
    return {"cycles": count / elapsed, "cpu": cpu / (count * FRAMES) * 1e6, "kernel_nodes": kernel}


def main(channel: str, runs: int, seconds: float) -> None:
    """Measure in turn, each host in its own process."""
    results = []
    for _ in range(runs):
        taken = {}
        for kind in ("ours", "peer"):
            command = [sys.executable, __file__, channel, kind, str(seconds)]
            taken[kind] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)
        results.append(taken)
    print(json.dumps(results))


if __name__ == "__main__":
    if sys.argv[2] in ("ours", "peer"):
        print(json.dumps(run(sys.argv[2], sys.argv[1], float(sys.argv[3]))), flush=True)
    else:
        main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
