"""The link paced at its rate on SocketCAN for a minute: rate held, cycles missed, share of a core, share of the wire.

    scripts/with-vcan .venv/bin/python benchmarks/paced_cycle.py [CHANNEL [SECONDS [RATE]]]

Seven joints with nodes of negligible cost (echo_nodes.py), so that only the host's process is measured. Prints JSON.
"""

import json
import sys
import time

import numpy as np
from echo_nodes import NODES, answer_in_kernel, make_arm, remove_gateway, start_nodes

from armlink.bus.frame_bits import frame_bits, longest_frame_bits
from armlink.bus.open import open_bus
from armlink.drives.canopen.pdo import RPDO1
from armlink.link.link import Link
from armlink.link.types import Command


def main(channel: str = "vcan0", seconds: float = 60.0, rate: float = 250.0) -> None:
    """Cycle for `seconds` and print the figures."""
    nodes = start_nodes(channel)
    bus = {"interface": "socketcan", "channel": channel}
    arm = make_arm(len(NODES), link={"bus": bus, "rate": rate, "deadline": 10.0})
    link = Link(arm, open_bus(None, arm.require_link().bus))
    kernel = False
    try:
        link.start()
        command = Command.hold(link.enable().position)
        kernel = answer_in_kernel(channel)
        for _ in range(100):
            link.cycle(command)
        count = int(seconds * rate)
        missed, latenesses = 0, np.empty(count)
        start, cpu = time.monotonic(), time.process_time()
        for cycle in range(count):
            sample = link.cycle(command)
            missed += bool(np.isnan(sample.position).any())
            latenesses[cycle] = sample.t
        elapsed, cpu = time.monotonic() - start, time.process_time() - cpu
    finally:
        if kernel:
            remove_gateway()
        nodes.terminate()
    periods = np.diff(latenesses) * 1e3
    # share of a cycle on the wire at 1 Mbit/s: 7 RPDO1, SYNC, 7 TPDO1, and 7 TPDO2 in every fourth
    data = RPDO1.layout.pack(15, 0, 1000)
    typical = frame_bits(0x80, b"") + sum(frame_bits(base + n, data) for base in (0x200, 0x180) for n in NODES)
    typical += sum(frame_bits(0x280 + n, data) for n in NODES) / 4
    most = longest_frame_bits(0) + 2.25 * len(NODES) * longest_frame_bits(8)
    answer = {
        "seconds": elapsed,
        "rate_hz": count / elapsed,
        "cycles": count,
        "missed": missed,
        "missed_share": missed / count,
        "late": link.stats.late,
        "skipped_share": max(0.0, 1 - count / elapsed / rate),
        "period_ms": {"p50": float(np.median(periods)), "p99.9": float(np.percentile(periods, 99.9))},
        "core_share": cpu / elapsed,
        "cpu_us_per_cycle": cpu / count * 1e6,
        "wire_share_at_1_Mbit": typical * rate / 1e6,
        "wire_share_at_most": most * rate / 1e6,
        "kernel_nodes": kernel,
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "vcan0", *(float(each) for each in sys.argv[2:]))
