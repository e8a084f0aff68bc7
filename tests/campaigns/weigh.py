"""Payloads of 0.1 to 5 kg, weighed on realistic arms (levels 0 to 3) with the records of their own sweeps.

    .venv/bin/python tests/campaigns/weigh.py --draws 40 --seed 0

Readings come from the simulated arm's own physics at rest (tests/calib/realistic_sweeps.py). Exit status 1 where fewer
than 95 % of the masses or of the coordinates of the centres are within their 95 % intervals.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from bounds import exit_status

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_payloads import calibrated_arm, draw_payload

from armlink.errors import Refused

LEVELS = (0.0, 1.0, 2.0, 3.0)
POSES = 12
SHARE, QUANTILE = 0.95, 1.96


def main() -> int:
    """Draw, weigh, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="number of the first draw")
    given = parser.parse_args()
    errors, seed = list[np.ndarray](), given.seed
    while len(errors) < given.draws:
        level = LEVELS[seed % len(LEVELS)]
        random = np.random.default_rng([seed, 9])
        mass, centre = draw_payload(random)
        try:
            weighed = calibrated_arm(seed, level).weigh(mass, centre, POSES, seed)
        except Refused as refused:  # an arm whose sweeps cannot tell the scale of torque, or that cannot hold this load
            print(f"{seed:>4}: left out: {refused}"[:110], flush=True)
            seed += 1
            continue
        errors.append(weighed.errors)
        found = weighed.found
        print(
            f"{seed:>4}: level {level:g}, {mass:.3f} kg, weighed {found.mass:.3f} ± {QUANTILE * found.mass_std:.3f}; "
            f"errors over std {np.round(weighed.errors, 2)}, std of centre {np.round(1e3 * found.centre_std, 1)} mm",
            flush=True,
        )
        seed += 1
    table = np.array(errors)
    told, inside = np.isfinite(table), np.abs(table) < QUANTILE
    masses, centres = inside[:, 0].mean(), inside[:, 1:][told[:, 1:]].mean()
    print(f"within their intervals: {masses:.1%} of masses, {centres:.1%} of {told[:, 1:].sum()} coordinates")
    wrong = [f"only {masses:.1%} of the masses"] * bool(masses < SHARE)
    return exit_status(wrong + [f"only {centres:.1%} of the coordinates of centres"] * bool(centres < SHARE))


if __name__ == "__main__":
    sys.exit(main())
