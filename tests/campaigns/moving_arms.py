"""Campaign: changes of drawn arms without torque sensors, found while they work: torque constant, friction, payload.

    python tests/campaigns/moving_arms.py [--draws 50] [--first 1] [--rows 900]

Each arm is calibrated by creep sweeps, works unchanged, and then with a torque constant off by 5 %, friction up by
30 %, 0.3 kg in its hand, and nothing. A change of a joint counts where the observer told that half of it would be
noticed; of the others a wrong answer counts, none does not. Prints a line a draw; exit status 1 if fewer than 95 % are
found, or anything was found that is not there.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_creeps import draw_creep
from drawn_work import NOTHING, Change, work
from judged_creeps import creep_arm

from calib.arm.kinematics import gcomp_arm
from calib.fit.creep_fit import fit_rows
from calib.observer.cause_test import cause_test
from calib.observer.observer import IN_MOTION, Observer
from calib.plan.creep_plan import plan_creep

GAIN, FRICTION, PAYLOAD = 0.05, 1.3, 0.3
UNCHANGED = 480
"""Rows of work before the change."""
SHARE = 0.95
KINDS = ("gain", "friction", "payload", "none")


def run(seed: int, rows: int) -> dict[str, tuple[bool, bool, str]]:
    """By kind: whether the change should be seen, whether it was told as it is, and what was told."""
    arm, random = creep_arm(seed), np.random.default_rng([seed, 17])
    plan = plan_creep(arm)
    made = draw_creep(arm, plan, seed, plan.reference_mass)
    kinematics, rated = gcomp_arm(arm), arm.require_link().rated_torques
    fit = fit_rows(kinematics, made.rows, rated)
    calibration = fit.record(arm)
    gravity = fit.gravity.record(arm, calibration)
    told: dict[str, tuple[bool, bool, str]] = {}
    for kind in KINDS:
        observer, events = Observer.in_motion(kinematics, calibration, gravity, rated), []
        before = work(arm, made, calibration, random, UNCHANGED)
        for row in before:
            events += observer.handle_row(row)
        test = cause_test(observer._belief, before[-IN_MOTION.longest :])
        joint = int(random.integers(kinematics.n))
        sign = random.choice([-1, 1])
        change = {
            "gain": Change(gain=1 + sign * GAIN, joint=joint),
            "friction": Change(friction=FRICTION, joint=joint),
            "payload": Change(payload=PAYLOAD),
            "none": NOTHING,
        }[kind]
        for row in work(arm, made, calibration, random, rows, change):
            events += observer.handle_row(row)
        size = {"gain": GAIN, "friction": FRICTION - 1}.get(kind)
        expected = size is None or size > 2 * test.noticed(kind, joint)
        name = kinematics.names[joint] if kind in ("gain", "friction") else None
        said = [(event.joint, event.evidence["cause"]) for event in events]
        right = said == [] if kind == "none" else said == [(name, kind)]
        wrong = not right and bool(said)
        text = f"{name or ''} {'; '.join(f'{where or chr(45)} {what}' for where, what in said) or 'nothing'}"
        told[kind] = expected or wrong, right, text.strip()
    return told


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--rows", type=int, default=900)
    given = parser.parse_args()
    counted: dict[str, list[bool]] = {kind: [] for kind in KINDS}
    for seed in range(given.first, given.first + given.draws):
        told = run(seed, given.rows)
        for kind, (expected, right, _) in told.items():
            if expected:
                counted[kind].append(right)
        line = "; ".join(
            f"{kind}: {text} ({'right' if right else 'WRONG' if expected else 'too small to be seen'})"
            for kind, (expected, right, text) in told.items()
        )
        print(f"{seed:>4}: {line}", flush=True)
    for kind, found in counted.items():
        print(f"{kind}: {sum(found)} of {len(found)} right")
    return int(any(sum(found) < SHARE * len(found) for found in counted.values()))


if __name__ == "__main__":
    sys.exit(main())
