"""How much faster than real time the simulated arm runs in lock-step, driven by raw frames with all PDOs on.

Run: python benchmarks/sim_real_time_factor.py [ARM]. Prints one JSON object; `runs` are the factors by CPU time.
"""

import json
import statistics
import struct
import sys
import time

from armlink.armfile import load_arm
from sim_bus.bus import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

RUNS, CYCLES = 5, 1000
CSP, CST = 8, 10


def main(name: str) -> None:
    """Sweep-like motion: one joint turns by cyclic positions while the others press on their stops."""
    described = load_arm(name)
    arm = SimulatedArm(described, Truth.draw(described, 1), 1)
    bus = LockStepBus(arm=arm)
    nodes = [node.node_id for node in arm.nodes]
    bus.put(0, b"\1\0")
    positions = [0] * arm.n
    drain(bus)
    cycle(bus, nodes, 0, [0] * arm.n, positions)
    positions = [struct.unpack("<i", bus_read(bus, node))[0] for node in nodes]
    for node in nodes:
        bus.put(0x300 + node, bytes([CSP]))
    for word in (6, 7, 15):
        cycle(bus, nodes, word, [0] * arm.n, positions)
    for node in nodes[1:]:
        bus.put(0x300 + node, bytes([CST]))
    for step in range(500):
        cycle(bus, nodes, 15, [step] * arm.n, positions)
    runs, frames = [], 0
    for run in range(RUNS):
        began = time.process_time()
        frames = 0
        for _ in range(CYCLES):
            positions[0] += 60 * (1 if run % 2 else -1)
            frames += cycle(bus, nodes, 15, [500] * arm.n, positions)
        runs.append(CYCLES * arm.period / (time.process_time() - began))
    bus.shutdown()
    ours = statistics.median(runs)
    result = {"name": "sim_real_time_factor", "ours": round(ours, 2), "peer": 1.0, "unit": "× real time"}
    result |= {"ratio": round(ours, 2), "peer_name": "real time at 250 Hz", "runs": [round(run, 2) for run in runs]}
    print(json.dumps(result | {"cpu_us_a_cycle": round(arm.period / ours * 1e6), "frames_a_cycle": frames / CYCLES}))


def cycle(bus: LockStepBus, nodes: list[int], word: int, torques: list[int], positions: list[int]) -> int:
    """Seven RPDOs and a SYNC out, all TPDOs in; the number of frames."""
    for node, torque, position in zip(nodes, torques, positions, strict=True):
        bus.put(0x200 + node, struct.pack("<Hhi", word, torque, position))
    bus.put(0x80, b"")
    return drain(bus) + len(nodes) + 1


def drain(bus: LockStepBus) -> int:
    """Take all frames off the bus; their number."""
    count = 0
    while bus.take() is not None:
        count += 1
    return count


def bus_read(bus: LockStepBus, node: int) -> bytes:
    """6064h over SDO."""
    bus.put(0x600 + node, bytes.fromhex("4064600000000000"))
    frame = bus.take()
    assert frame is not None
    return frame[1][4:]


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "sarcos")
