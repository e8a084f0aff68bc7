"""Campaign: the demo over many hidden truths, judged by its accuracy and the coverage of its intervals.

python tests/campaigns/demo_seeds.py [--arm sarcos] [--seeds 1 10] [--jobs 2] [--out DIR]
Exit status 1 if a bound fails.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

GAIN, LAST_GAIN, OFFSET, GRAVITY = 0.005, 0.01, 0.05, 0.005
"""Largest errors: gain, gain of the last joint, offset [N·m], gravity RMS as a share of the largest torque."""
COVERAGE = (0.90, 0.99)


def run(arm: str, seed: int, out: Path) -> dict[str, Any]:
    """One demo; its summary, or what it said when it failed."""
    folder = out / f"seed-{seed}"
    command = [Path(sys.executable).with_name("armlink"), "demo", "--arm", arm, "--seed", str(seed), "--out", folder]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return {"seed": seed, "failed": f"exit status {done.returncode}: {done.stderr.strip().splitlines()[-1]}"}
    return dict(json.loads((folder / "summary.json").read_text(encoding="utf-8")))


def judge(summary: dict[str, Any]) -> tuple[list[str], dict[str, float], list[bool]]:
    """(What is out of bounds, worst errors, whether each interval holds the truth)."""
    if "failed" in summary:
        return [summary["failed"]], {}, []
    sensors, gravity, drift = summary["sensors"], summary["gravity"], summary["drift"]
    joints = summary["joints"]
    true, found = (np.array(sensors["gain"][key], dtype=float) for key in ("true", "estimated"))
    gain = np.abs(found / true - 1)
    bound = np.full(len(joints), GAIN)
    bound[-1] = LAST_GAIN
    offset = np.abs(np.subtract(*(np.array(sensors["offset"][key], dtype=float) for key in ("estimated", "true"))))
    largest = np.array(gravity["max_torque"])
    share = np.array(gravity["rms_error"]) / np.maximum(largest, 1e-9)
    wrong = [f"{joints[j]}: gain error {gain[j]:.2%}" for j in np.flatnonzero(gain > bound)]
    wrong += [f"{joints[j]}: offset error {offset[j]:.3f} N·m" for j in np.flatnonzero(offset > OFFSET)]
    wrong += [f"{joints[j]}: gravity RMS {share[j]:.2%}" for j in np.flatnonzero((share > GRAVITY) & (largest > 1e-6))]
    if not drift["recalibrated"]:
        wrong.append("drift not recalibrated")
    held = [
        low <= value <= high
        for parameter in sensors.values()
        for value, interval in zip(parameter["true"], parameter["ci95"], strict=True)
        if interval is not None
        for low, high in [interval]
    ]
    worst = {
        "gain": float(np.nanmax(gain)),
        "offset": float(np.nanmax(offset)),
        "gravity": float(share[largest > 1e-6].max()),
        "drift_gain": drift["gain_error_after"],
        "drift_offset": drift["offset_error_after"],
        "wall_s": summary["wall_s"],
    }
    return wrong, worst, held


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arm", default="sarcos")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 10), metavar=("FIRST", "LAST"))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("campaign-demo"))
    given = parser.parse_args()
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    failed, inside = 0, list[bool]()
    with ThreadPoolExecutor(given.jobs) as pool:
        for seed, summary in zip(seeds, pool.map(lambda s: run(given.arm, s, given.out), seeds), strict=True):
            wrong, worst, held = judge(summary)
            inside += held
            failed += bool(wrong)
            numbers = ", ".join(f"{name} {value:.4g}" for name, value in worst.items())
            print(
                f"seed {seed}: {numbers}; {sum(held)} of {len(held)} intervals hold; {'; '.join(wrong) or 'ok'}",
                flush=True,
            )
    share = float(np.mean(inside)) if inside else 0.0
    print(f"{share:.1%} of {len(inside)} intervals hold the truth (asked: {COVERAGE[0]:.0%} to {COVERAGE[1]:.0%})")
    print(f"{len(seeds) - failed} passed, {failed} failed")
    return int(failed > 0 or not COVERAGE[0] <= share <= COVERAGE[1])


if __name__ == "__main__":
    sys.exit(main())
