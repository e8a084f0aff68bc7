"""Frames with any identifier, length and content at the drives of every family: `fuzz_drives.py [--frames 100000]`.

No frame may raise, be read as a number that is infinite, or make an order leave beyond a limit.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))

from fuzzing import fuzz


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    arms = ["six-damiao", "six-cubemars", "six-robstride", "six-moteus", "six-odrive", "six-cia402"]
    parser.add_argument("--arm", nargs="*", default=arms)
    asked = parser.parse_args()
    for arm in asked.arm:
        print(f"{arm}: {fuzz(arm, asked.frames, asked.seed)} frames", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
