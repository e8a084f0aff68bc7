"""Campaign: hostile frames against the guard of a bus, and what the guard costs a cycle.

    python tests/campaigns/fuzz_guard.py [--frames 100000] [--seed 0] [--seconds 0]

The policy of a two-joint arm gets random frames, frames near those of the cycle and SDO writes, each judged as if no
other had been refused. The joints do what they are told at once, so that small steps from where they are add up. Of the
frames that pass none may be beyond a limit: they are decoded by themselves. Then the cycle of seven joints passes it,
in its own processor time. Exit status 1 for a frame beyond.
"""

import argparse
import json
import random
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "armlink"))
sys.path.insert(0, str(Path(__file__).parent.parent / "armlink" / "guard"))

from compromised import COMMAND, PERIOD, RATE_COUNTS, SPEED_COUNTS, Joints, content_of
from fuzz_journal import for_seconds

from armlink.guard.bus_guard import Policy

FIRST, MOST_NODES, AGAIN = 0x200, 7, 2000
"""Identifier of RPDO1 without the node; joints of the arm that is timed; frames after which new joints are taken."""


def hostile(draw: random.Random, joints: Joints) -> tuple[int, bytes]:
    """A frame that a compromised program could send."""
    kind = draw.random()
    if kind < 0.15:
        return draw.randrange(0x800), draw.randbytes(draw.randrange(9))
    if kind < 0.35:
        known = [0x6072, 0x607D, 0x607A, 0x6071, 0x6060, 0x1400, 0x1600, 0x1016, 0x2100, draw.randrange(65536)]
        command = draw.choice([0x23, 0x2B, 0x2F, 0x22, 0x21, 0xC6, 0x40])
        data = struct.pack("<BHBI", command, draw.choice(known), draw.randrange(10), draw.getrandbits(32))
        return 0x600 + draw.choice([1, 2]), data
    node = draw.choice([1, 2])
    if draw.random() < 0.2:
        position, torque = draw.randrange(-(2**31), 2**31), draw.randrange(-1200, 1200)
    else:  # a step as large as may pass, or a few counts
        share = draw.choice([0.0, 0.9, 1.1, 4.0])
        side = draw.choice([-1, 1])
        position = joints.position[node] + side * round(share * SPEED_COUNTS * PERIOD + draw.randrange(4))
        torque = joints.torque[node] + side * round(share * RATE_COUNTS * PERIOD + draw.randrange(4))
    word = draw.choice([0x0F, 0x0F, 0x0F, 0x0F, 0x8F, 0x06, 0, 2, draw.randrange(65536)])
    bounded = max(-32768, min(32767, torque)), max(-(2**31), min(2**31 - 1, position))
    return FIRST + node, COMMAND.pack(word, *bounded)


def fuzz(frames: int, seed: int) -> dict[str, object]:
    """Send the frames; how many passed, and those beyond a limit."""
    draw, joints, passed, beyond = random.Random(seed), Joints(), 0, []
    for number in range(frames):
        if number % AGAIN == 0:
            joints = Joints()
            joints.stand(1, draw.randrange(-400_000, 400_000))
        went, wrong = joints.send(*hostile(draw, joints), draw.expovariate(1 / PERIOD))
        passed += went
        beyond += [wrong] if wrong else []
    return {"frames": frames, "passed": passed, "beyond": beyond[:20]}


def for_a_while(seed: int) -> dict[str, int]:
    found = fuzz(20_000, seed)
    assert not found["beyond"], found["beyond"]
    return {"frames": int(str(found["frames"])), "passed": int(str(found["passed"]))}


def cost() -> float:
    """Processor time for the frames of one cycle of seven joints, both ways [s]."""
    policy, cycles = Policy(content_of(MOST_NODES)), 2000
    nodes = range(1, MOST_NODES + 1)
    for can_id, prefix in {each for node in nodes for each in policy.frames[FIRST + node].after}:
        policy.hear(can_id, prefix, 0.0)
    command, reading, motor = COMMAND.pack(15, 0, 0), struct.pack("<ii", 0, 2_000_000), COMMAND.pack(0x27, 0, 0)
    begin = time.process_time()
    for cycle in range(cycles):
        now = cycle * PERIOD
        for node in nodes:
            policy.hear(0x180 + node, reading, now)
            policy.hear(0x280 + node, motor, now)
        for node in nodes:
            assert not policy.refusal(FIRST + node, command, now)
        assert not policy.refusal(0x80, b"", now)
    return (time.process_time() - begin) / cycles


def main() -> int:
    """Fuzz, then measure."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=0.0, help="so much processor time instead, noted")
    options = parser.parse_args()
    if options.seconds:
        for_seconds("frames at the guard", options.seconds, options.seed, for_a_while)
        return 0
    found = fuzz(options.frames, options.seed) | {"check_ms_a_cycle": round(cost() * 1e3, 4)}
    print(json.dumps(found, indent=1))
    return 1 if found["beyond"] else 0


if __name__ == "__main__":
    sys.exit(main())
