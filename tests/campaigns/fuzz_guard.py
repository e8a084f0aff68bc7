"""Campaign: hostile frames against the guard of a bus, and what the guard costs a cycle.

    python tests/campaigns/fuzz_guard.py [--frames 100000] [--seed 0]

A guard with the policy of a two-joint arm gets random frames, frames near those of the cycle and SDO writes, opened
again each time that it closes. Of those that reach the wire none may be beyond a limit: they are decoded here, by
themselves. Then the cycle of seven joints passes it, in its own processor time. Exit status 1 for a frame beyond.
"""

import argparse
import json
import math
import random
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "armlink"))
sys.path.insert(0, str(Path(__file__).parent.parent / "armlink" / "guard"))

from test_bus_guard import CONTENT, ENABLED_AT, HEARD, MAX_TORQUE, PERIOD, RATE, RATED, SPEED, UNIT, WINDOW, content_of

from armlink.guard.bus_guard import Policy

FIRST, MOST_NODES = 0x200, 7


def hostile(draw: random.Random, last: dict[int, tuple[int, int]]) -> tuple[int, bytes]:
    """A frame that a compromised program could send."""
    kind = draw.random()
    if kind < 0.2:
        return draw.randrange(0x800), draw.randbytes(draw.randrange(9))
    if kind < 0.45:
        index = draw.choice(
            [0x6072, 0x607D, 0x607A, 0x6071, 0x6060, 0x1400, 0x1600, 0x1016, 0x2100, draw.randrange(65536)]
        )
        command = draw.choice([0x23, 0x2B, 0x2F, 0x22, 0x21, 0xC6, 0x40])
        return 0x600 + draw.choice([1, 2]), struct.pack(
            "<BHBI", command, index, draw.randrange(10), draw.getrandbits(32)
        )
    node = draw.choice([1, 2])
    position, torque = last.get(node, (0, 50))
    far = draw.random() < 0.3
    position = draw.randrange(-(2**31), 2**31) if far else round(position + draw.gauss(0, SPEED * PERIOD / UNIT))
    torque = draw.randrange(-1200, 1200) if far else round(torque + draw.gauss(0, RATE / RATED * 1000 * PERIOD))
    word = draw.choice([15, 15, 15, 6, 0, 2, draw.randrange(65536)])
    return FIRST + node, struct.pack(
        "<Hhi", word, max(-32768, min(32767, torque)), max(-(2**31), min(2**31 - 1, position))
    )


def wrong(can_id: int, data: bytes, now: float, told: dict[int, tuple[int, int, float]]) -> str:
    """What in a frame that passed is beyond a limit."""
    node = can_id & 0x7F
    if can_id & 0x780 != FIRST:
        return ""
    word, torque, position = struct.unpack("<Hhi", data)
    if abs(torque) > 1000 * MAX_TORQUE / RATED or abs(position) > WINDOW + 1:
        return f"{can_id:X}h: torque {torque}, position {position}"
    if word & 0x8F != 0x0F:
        told.pop(node, None)
        return ""
    last, pull, then = told.get(node, (0, 50, math.inf))
    elapsed = max(0.0, now - then) + 5 * PERIOD
    near = abs(position) <= 3 + 2 * PERIOD * SPEED / UNIT or abs(position - last) <= SPEED / UNIT * elapsed + 3
    same = abs(torque - 50) <= 2 or abs(torque - pull) <= RATE / RATED * 1000 * elapsed + 3
    told[node] = position, torque, now
    return "" if near and same else f"{can_id:X}h: from {pull}, {last} to {torque}, {position} in {elapsed:.3f} s"


def fuzz(frames: int, seed: int) -> dict[str, object]:
    """Send the frames; how many passed, and those beyond a limit."""
    draw, policy, now = random.Random(seed), Policy(CONTENT), ENABLED_AT
    for each in HEARD:
        policy.hear(*each)
    told: dict[int, tuple[int, int, float]] = {}
    passed, beyond = 0, []
    for _ in range(frames):
        now += draw.expovariate(1 / PERIOD)
        last = {node: (position, torque) for node, (position, torque, _) in told.items()}
        can_id, data = hostile(draw, last)
        if not policy.refusal(can_id, data, now):
            passed += 1
            found = wrong(can_id, data, now, told)
            if found:
                beyond.append(found)
    return {"frames": frames, "passed": passed, "beyond": beyond[:20]}


def cost() -> float:
    """Processor time for the frames of one cycle of seven joints, both ways [s]."""
    policy, cycles = Policy(content_of(MOST_NODES)), 2000
    for node in range(1, MOST_NODES + 1):
        policy._acknowledged |= policy.frames[FIRST + node].after
    command, reading = struct.pack("<Hhi", 15, 50, 0), struct.pack("<ii", 0, 2_000_000)
    begin = time.process_time()
    for cycle in range(cycles):
        for node in range(1, MOST_NODES + 1):
            assert not policy.refusal(FIRST + node, command, cycle * PERIOD) or cycle == 0
        policy.refusal(0x80, b"", cycle * PERIOD)
        for node in range(1, MOST_NODES + 1):
            policy.hear(0x180 + node, reading, cycle * PERIOD)
            policy.hear(0x280 + node, struct.pack("<Hhi", 0x27, 50, 0), cycle * PERIOD)
    return (time.process_time() - begin) / cycles


def main() -> int:
    """Fuzz, then measure."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = fuzz(options.frames, options.seed) | {"check_ms_a_cycle": round(cost() * 1e3, 4)}
    print(json.dumps(found, indent=1))
    return 1 if found["beyond"] else 0


if __name__ == "__main__":
    sys.exit(main())
