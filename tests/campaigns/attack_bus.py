"""Campaign: attacks on a real SocketCAN bus, on hosts with and without a guard, at drawn moments of a motion.

    scripts/with-vcan python tests/campaigns/attack_bus.py [--rounds 3] [--seed 0] [--only WORD]

Each round makes every attack of `tests/faults/bus_attacks.py` once. Exit status 1 if a joint was faster than its motion
by 1 rad/s, or did not hold when its host had ended.
"""

import argparse
import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))

from bus_attacks import BARE, GUARDED, scene


def main() -> int:
    """Attack, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="attacks with this in their name")
    options = parser.parse_args()
    draw, wrong, made, fastest = random.Random(options.seed), 0, 0, 0.0
    attacks = [(True, name, each) for name, each in GUARDED.items()] + [(False, *each) for each in BARE.items()]
    with tempfile.TemporaryDirectory() as folder, scene(Path(folder)) as place:
        for _ in range(options.rounds):
            for guarded, name, attack in attacks:
                if options.only not in name:
                    continue
                found = place.attack(attack, guarded, draw.uniform(0.0, 0.5))
                made, wrong, fastest = made + 1, wrong + bool(found.wrong), max(fastest, found.motion.fastest)
                said = " | ".join(each for each in (found.host or "goes on", found.guard, *found.others) if each)
                print(f"{'guard' if guarded else 'bare'}: {name}: {found.motion.fastest:.2f} rad/s,", end=" ")
                print(f"{found.wrong or 'as it should be'}: {said}".replace("\n", " | "), flush=True)
    print(f"{made} attacks, fastest joint {fastest:.2f} rad/s, {wrong} not as they should be")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
