"""Sweep, calibrate and identify random arms and the bundled ones, and tell what came out.

    .venv/bin/python tests/campaigns/random_arms.py --seeds 1 20

An arm takes half a minute to two. Exit status 1 where a bound is broken or the intervals do not cover.
"""

import argparse
import math
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_arms import BUNDLED, Verdict, asked_arm, judge, sweep

from sim_bus.simulated_arm import SimulatedArm


def run(which: str, keep: Path | None) -> Verdict:
    """Both passes of one arm, named or by the number of its seed."""
    arm, truth = asked_arm(which)
    simulated = SimulatedArm(arm, truth, 1)
    with tempfile.TemporaryDirectory() as scratch:
        data = sweep(simulated, (keep / which) if keep else Path(scratch))
        return judge(arm, simulated.true_sensors, data)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--only-random", action="store_true", help="leave the bundled arms out")
    parser.add_argument("--keep", type=Path, help="directory that keeps the data sets")
    given = parser.parse_args()
    names = [str(seed) for seed in range(given.seeds[0], given.seeds[1] + 1)]
    names = names if given.only_random else [*names, *BUNDLED]
    inside, failed = list[bool](), list[str]()
    for name in names:
        began = time.monotonic()
        try:
            verdict = run(name, given.keep)
        except Exception as error:  # an arm that fails is a result, too
            failed.append(name)
            print(f"{name:>9}: FAILED {type(error).__name__}: {error}", flush=True)
            traceback.print_exc()
            continue
        inside += verdict.inside
        if verdict.wrong:
            failed.append(name)
        lost = ", ".join(f"{joint}.{parameter}" for joint, parameter in sorted(verdict.fit.reasons)) or "none"
        robot = [each.t for each in (data.readings[-1] for data in verdict.data)][-1]
        print(
            f"{name:>9}: {len(verdict.arm.joint_names)} joints, gain {verdict.gain:.3%}, offset {verdict.offset:.3%}"
            f" of rated, gravity {verdict.gravity:.3%}, {sum(verdict.inside)}/{len(verdict.inside)} intervals hold,"
            f" chi2/dof {verdict.fit.fit.chi2 / max(verdict.fit.fit.dof, 1):.2f}, noise x"
            f" {' '.join(f'{factor:.2f}' for factor in verdict.fit.noise_factor)}; unobservable: {lost};"
            f" said to be imprecise: {' '.join(verdict.fit.imprecise) or 'none'};"
            f" {robot:.0f} s of robot time, {time.monotonic() - began:.0f} s; {'; '.join(verdict.wrong) or 'ok'}",
            flush=True,
        )
    share = float(np.mean(inside)) if inside else 0.0
    doubt = 2 * math.sqrt(0.95 * 0.05 / max(len(inside), 1))
    print(f"{share:.1%} of {len(inside)} intervals hold the truth (asked: 92 % to 98 %, by chance ± {doubt:.1%})")
    print(f"{len(names) - len(failed)} of {len(names)} arms within bounds; not: {' '.join(failed) or 'none'}")
    return int(bool(failed) or not 0.92 <= share <= 0.98)


if __name__ == "__main__":
    sys.exit(main())
