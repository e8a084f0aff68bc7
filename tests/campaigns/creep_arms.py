"""Creep sweeps of drawn arms without torque sensors, beside steps at rest and the nominal feed-forward.

    .venv/bin/python tests/campaigns/creep_arms.py --seeds 1 20

An arm takes one to two minutes, half as long without the steps (--no-steps). Exit status 1 where a bound is broken or
the intervals do not cover.
"""

import argparse
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from judged_creeps import CreepVerdict, creep_arm, creep_passes, judge_creep, steps_error

from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

MEDIAN = 0.004
COVER = (0.92, 0.98)


def run(seed: int, steps: bool) -> CreepVerdict:
    """All passes of one arm."""
    arm = creep_arm(seed)
    simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
    with tempfile.TemporaryDirectory() as scratch:
        at_rest = steps_error(arm, seed, Path(scratch)) if steps else None
        data = creep_passes(arm, simulated, Path(scratch))
        return judge_creep(arm, simulated, data, at_rest)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--no-steps", action="store_true", help="leave the steps at rest out")
    given = parser.parse_args()
    verdicts, failed = list[CreepVerdict](), list[int]()
    for seed in range(given.seeds[0], given.seeds[1] + 1):
        began = time.monotonic()
        try:
            verdict = run(seed, not given.no_steps)
        except Exception as error:  # an arm that fails is a result, too
            failed.append(seed)
            print(f"{seed:>4}: FAILED {type(error).__name__}: {error}", flush=True)
            traceback.print_exc()
            continue
        verdicts.append(verdict)
        if verdict.wrong:
            failed.append(seed)
        print(
            f"{seed:>4}: {len(verdict.names)} joints, gain {worst(verdict.gain):.2%} at worst, gravity"
            f" {worst(verdict.gravity):.2%} (steps {worst(verdict.gravity_steps):.1%}, nominal"
            f" {worst(verdict.gravity_nominal):.1%}), {sum(verdict.gain_inside)}/{len(verdict.gain_inside)} gains and"
            f" {sum(verdict.other_inside)}/{len(verdict.other_inside)} others inside; {time.monotonic() - began:.0f} s"
            + "".join(f"\n      {each}" for each in verdict.wrong),
            flush=True,
        )
    return tell(verdicts, failed)


def tell(verdicts: list[CreepVerdict], failed: list[int]) -> int:
    """The whole, and the exit status."""
    gains = np.abs(np.concatenate([each.gain for each in verdicts]))
    gains = gains[np.isfinite(gains)]
    inside = [hit for each in verdicts for hit in each.gain_inside]
    others = [hit for each in verdicts for hit in each.other_inside]
    if not gains.size:
        print(f"{len(verdicts)} arms, no gain given; out of bounds: {failed or 'none'}")
        return int(bool(failed))
    median, share = float(np.median(gains)), (sum(inside) + sum(others)) / max(len(inside) + len(others), 1)
    print(
        f"{len(verdicts)} arms, {len(gains)} gains: worst {gains.max():.2%}, median {median:.2%}; intervals hold:"
        f" {sum(inside)}/{len(inside)} gains, {sum(others)}/{len(others)} others, {share:.1%} of all;"
        f" out of bounds: {failed or 'none'}"
    )
    few = len(inside) + len(others) < 300
    covered = COVER[0] <= share <= COVER[1] or (few and share >= 0.85)
    return int(bool(failed) or median > MEDIAN or not covered)


def worst(values: np.ndarray) -> float:
    """Largest size; NaN where there is none."""
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else float("nan")


if __name__ == "__main__":
    sys.exit(main())
