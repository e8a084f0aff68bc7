"""The scale check on every family: scales off by a tenth and more are found, sound ones are not named.

`scales.py [--draws 20] [--family six-damiao …]`; a draw is a hidden truth, and one joint one of whose scales is off by
10 to 40 %. A hand turns the joints from stop to stop, then the host moves them. Exit status 0 where every scale that
was off was named, and nothing else.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "selftest"))

from moved_by_hand import ALL, judged

from armlink.errors import BadInput

EITHER = "position or velocity"
LOADED = 3
"""Torque scales are judged by torque: they are drawn on the joints that carry the others, the first three."""


def drawn(name: str, seed: int) -> tuple[int, str, float]:
    random = np.random.default_rng([seed, 77])
    quantity = ("position", "velocity", "torque")[seed % 3]
    joint = int(random.integers(LOADED if quantity == "torque" else 6))
    off = float(random.uniform(0.10, 0.40))
    return joint, quantity, 1 + off if random.random() < 0.5 else 1 / (1 + off)


def one(name: str, seed: int) -> list[str]:
    """What was wrong in one draw; empty: nothing."""
    sound = judged(name, {}, seed)
    wrong = [f"sound joint {j}: {each}" for j, each in enumerate(sound) if each]
    joint, quantity, factor = drawn(name, seed)
    what = f"joint {joint} {quantity} {factor:.3f}"
    try:
        found = judged(name, {joint: (quantity, factor)}, seed)
    except BadInput as refused:  # a rated torque that is not that of the drive is refused at the start
        return wrong + ([] if quantity == "torque" and "6076h" in str(refused) else [f"{what}: {refused}"])
    allowed = {quantity, EITHER} | ({"velocity"} if name == "six-cia402" else set())
    if quantity not in found[joint] or not set(found[joint]) <= allowed:
        wrong.append(f"{what}: found {found[joint]}")
    wrong += [f"{what}: joint {j} is sound: {each}" for j, each in enumerate(found) if each and j != joint]
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--family", nargs="*", default=list(ALL))
    asked = parser.parse_args()
    failed = 0
    for name in asked.family:
        wrong = [(seed, text) for seed in range(asked.draws) for text in one(name, seed)]
        failed += len(wrong)
        print(f"{name}: {asked.draws} draws off, {asked.draws} sound: {len(wrong)} wrong", flush=True)
        for seed, text in wrong:
            print(f"  seed {seed}: {text}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
