"""Campaign: a million random and mutated frames into the decoder, the SDO client and the gate.

python tests/campaigns/fuzz_frames.py [--frames 1000000] [--seed 1] [--seconds 0]
With --seconds for so much processor time instead, noted in `fuzz_runs.jsonl`.

Exit status 1 on an exception other than the link's own refusals and faults, or on a frame that exceeds a limit.
"""

import argparse
import random
import struct
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink"))
sys.path.insert(0, str(Path(__file__).parent))
from fuzz_journal import for_seconds

from armlink.drives.orders import Order, Power
from armlink.errors import ArmlinkError
from armlink.link.link import Link
from armlink.link.types import Command
from tests.armlink.fake_joints import make_arm
from tests.armlink.link.test_gate_bytes import N, Observed, judge

BATCH, A_GO = 25, 20_000
"""Frames a cycle; frames of each seed, with --seconds."""
SHARES = {"decoder": 0.6, "link": 0.3, "sdo": 0.1}
BASES = (0x000, 0x080, 0x180, 0x200, 0x280, 0x300, 0x380, 0x580, 0x600, 0x700)


def random_frame(rng: random.Random) -> tuple[int, bytes]:
    """Any identifier, any length up to that of CAN FD, any content; half of them with an identifier that matters."""
    can_id = rng.choice(BASES) + rng.randrange(4) if rng.random() < 0.5 else rng.randrange(0x800)
    return can_id, rng.randbytes(rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 12, 64)))


def mutated_frame(rng: random.Random) -> tuple[int, bytes]:
    """A frame that a node might send, with bits flipped, cut short, or its values anything; seldom one that faults."""
    node = rng.randrange(1, N + 1)
    kind = rng.random()
    if kind < 0.5:
        can_id, data = 0x180 + node, struct.pack("<ii", rng.randrange(-(2**31), 2**31), rng.randrange(-(2**31), 2**31))
    elif kind < 0.8:
        can_id = 0x280 + node
        data = struct.pack("<Hhi", 0x27, rng.randrange(-(2**15), 2**15), rng.randrange(-400_000, 400_000))
    elif kind < 0.99:
        can_id, data = 0x580 + node, rng.randbytes(8)
    else:
        return random_frame(rng)
    if rng.random() < 0.1:
        data = data[: rng.randrange(8)]
    if rng.random() < 0.01:
        flipped = bytearray(data or b"\0")
        flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
        data = bytes(flipped)
    return can_id, data


def fuzz_decoder(rng: random.Random, frames: int) -> int:
    """Random frames into the loop alone; frames taken in."""
    bus = Observed(range(1, N + 1))
    link = Link(make_arm(N), bus)
    link._loop.verify = lambda joint, sent: None  # the gate knows no joint before the start
    idle, done = [Order(Power.OFF, False, 0, 0.0, 0.0, 0.0, 0.0, 0.0)] * N, 0
    while done < frames:
        bus.out.extend(random_frame(rng) for _ in range(BATCH))
        link._loop.drain()
        link._loop.exchange(idle, link.clock.now())
        done += BATCH
        bus.sent.clear()
        bus.left.clear()
    assert len(link.groups[0].drives.known.emergencies) <= 64
    return done


def fuzz_link(rng: random.Random, frames: int) -> tuple[int, int]:
    """Mutated frames and arbitrary commands into a whole link; frames taken in, commands refused or faulted."""
    done = refused = 0
    bus = Observed(range(1, N + 1))
    for node in bus.nodes.values():
        node.values[0x6502, 0] = struct.pack("<I", 0x289)
        node.modes = (1, 4, 8, 10)
    values = [0.0, 1.0, -1.0, 29.0, 1e3, -1e3, 1e300, float("nan"), float("inf")]
    with Link(make_arm(N), bus) as link:
        while done < frames:
            if not link._enabled:
                bus.out.clear()
                for node in bus.nodes.values():
                    node.__dict__.update(status=0x40, velocity=0, position=0, motor=0)
                link.start()
                link.enable()
            mode = rng.choice((0, 1, 4, 8, 8, 8, 10, 10, 10, 7))
            bus.out.extend(mutated_frame(rng) for _ in range(BATCH))
            done += BATCH
            last = {node: (bus.mode[node], each.control) for node, each in bus.nodes.items()}
            bus.left.clear()
            bus.sent.clear()
            bus.collecting = False
            weights = [9] * 6 + [1] * 3
            torque, position = (np.array(rng.choices(values, weights, k=N)) for _ in range(2))
            try:
                link.cycle(Command(np.full(N, mode, np.int8), torque, position))
            except ArmlinkError:
                refused += 1
            judge(bus, last)
    return done, refused


def fuzz_sdo(rng: random.Random, frames: int) -> tuple[int, int]:
    """Mutated answers to the SDO client while a link starts; answers given, starts that were refused."""
    given = refused = 0

    class Mad(Observed):
        def take(self, timeout: float = 0.0) -> tuple[int, bytes] | None:
            nonlocal given
            frame = super().take(timeout)
            if frame is None or frame[0] & 0x780 != 0x580:
                return frame
            given += 1
            data = bytearray(frame[1])
            chance = rng.random()
            if chance < 0.02:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            elif chance < 0.03:
                data = bytearray(rng.randbytes(rng.randrange(9)))
            return frame[0], bytes(data)

    while given < frames:
        try:
            with Link(make_arm(N), Mad(range(1, N + 1))) as link:
                link.start()
        except ArmlinkError:
            refused += 1
    return given, refused


def main() -> int:
    """Run, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=0.0)
    given = parser.parse_args()
    if given.seconds:
        for_seconds("frames of canopen", given.seconds, given.seed, lambda seed: fuzz(A_GO, seed))
        return 0
    start = time.monotonic()
    print(f"{fuzz(given.frames, given.seed)}, none unsafe, no other exception; {time.monotonic() - start:.0f} s")
    return 0


def fuzz(frames: int, seed: int) -> dict[str, int]:
    """Frames into decoder, link and SDO client; how many, and how often commands and starts were refused."""
    rng = random.Random(seed)
    decoded = fuzz_decoder(rng, int(frames * SHARES["decoder"]))
    passed, refused = fuzz_link(rng, int(frames * SHARES["link"]))
    answers, starts = fuzz_sdo(rng, int(frames * SHARES["sdo"]))
    found = {"frames": decoded + passed + answers, "commands": passed // BATCH, "refused": refused}
    return found | {"answers": answers, "starts_refused": starts}


if __name__ == "__main__":
    sys.exit(main())
