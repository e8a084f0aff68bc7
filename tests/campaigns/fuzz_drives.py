"""Frames with any identifier, length and content at the drives of every family: `fuzz_drives.py [--frames 100000]`.

With --seconds 3600 for so much processor time of each family instead, noted in `fuzz_runs.jsonl`. No frame may raise,
be read as a number that is infinite, or make an order leave beyond a limit.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))

from fuzz_journal import for_seconds
from fuzzing import FAMILIES, fuzz

A_GO = 5000
"""Frames before the drives are set up anew, with --seconds."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--arm", nargs="*", default=FAMILIES, choices=FAMILIES)
    asked = parser.parse_args()
    for arm in asked.arm:
        if asked.seconds:
            kind = f"frames of {arm.removeprefix('six-')}"
            for_seconds(kind, asked.seconds, asked.seed, lambda seed, arm=arm: {"frames": fuzz(arm, A_GO, seed)})
            continue
        print(f"{arm}: {fuzz(arm, asked.frames, asked.seed)} frames", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
