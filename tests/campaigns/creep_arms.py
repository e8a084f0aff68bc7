"""Creep sweeps of drawn arms without torque sensors, beside steps at rest and the nominal feed-forward.

    .venv/bin/python tests/campaigns/creep_arms.py --seeds 1 20

An arm takes one to two minutes, half as long without the steps (--no-steps). With --keep DIR the data sets stay there,
and those that are there already are judged again without being swept. Exit status 1 where a bound is broken or the
intervals do not cover.
"""

import argparse
import json
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from judged_creeps import CreepVerdict, creep_arm, creep_passes, judge_creep, steps_error

from calib.dataset import load_data
from calib.fit.calibration import QUANTILE
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

MEDIAN = 0.004
COVER = (0.92, 0.98)


def run(seed: int, steps: bool, folder: Path) -> CreepVerdict:
    """All passes of one arm, with their data sets in this folder, where they may be already."""
    arm = creep_arm(seed)
    simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
    ended, compared = folder / "ended.json", folder / "steps.json"
    if ended.exists():
        data = [load_data(folder / name) for name in json.loads(ended.read_text())["passes"]]
        simulated.time = json.loads(ended.read_text())["time"]
    else:
        data = creep_passes(arm, simulated, folder)
        ended.write_text(json.dumps({"time": simulated.time, "passes": [each.path.name for each in data]}))
    if steps and not compared.exists():
        at_rest = steps_error(arm, seed, folder)
        compared.write_text(json.dumps(None if at_rest is None else at_rest.tolist()))
    kept = json.loads(compared.read_text()) if steps else None
    return judge_creep(arm, simulated, data, None if kept is None else np.array(kept))


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--no-steps", action="store_true", help="leave the steps at rest out")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep the data sets here, or judge those that are here"
    )
    given = parser.parse_args()
    verdicts, failed = list[CreepVerdict](), list[int]()
    for seed in range(given.seeds[0], given.seeds[1] + 1):
        began = time.monotonic()
        try:
            with tempfile.TemporaryDirectory() as scratch:
                folder = (given.keep or Path(scratch)) / str(seed)
                folder.mkdir(parents=True, exist_ok=True)
                verdict = run(seed, not given.no_steps, folder)
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
            + "".join(f"\n      {each}" for each in verdict.wrong)
            + "".join(f"\n      not seen: {each}" for each in verdict.unseen),
            flush=True,
        )
    return tell(verdicts, failed)


def tell(verdicts: list[CreepVerdict], failed: list[int]) -> int:
    """The whole, and the exit status."""
    for family in verdicts[0].scores if verdicts else ():
        score = np.concatenate([each.scores[family] for each in verdicts])
        if not score.size:
            continue
        print(
            f"  {family:>8}: {len(score)} values, {np.mean(np.abs(score) < QUANTILE):.1%} within 95 %;"
            f" error over standard deviation: RMS {np.sqrt(np.mean(score**2)):.2f}, largest {np.abs(score).max():.1f}"
        )
    for what in ("gravity", "gravity_steps", "gravity_nominal"):
        shares = np.concatenate([np.nan_to_num(getattr(each, what), nan=-1.0) for each in verdicts])
        shares = shares[shares >= 0]
        if shares.size:
            print(f"  {what}: {len(shares)} joints, RMS error worst {shares.max():.2%}, median {np.median(shares):.2%}")
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
