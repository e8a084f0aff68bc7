"""Gravity from poses at rest: drawn MuJoCo arms of 3 to 7 joints, friction, gains, offsets; and a large real set.

    .venv/bin/python tests/campaigns/poses.py --draws 40 --seed 0

Exit status 1 where fewer than 95 % of the joints' RMS errors are within their bounds, where Pinocchio has other torques
in a written URDF, or where a set of 3,000 real poses takes longer than 20 s of a core.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from bounds import exit_status

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_poses import draw, outcome
from real_poses import real_poses

from calib.arm.kinematics import stated_model
from calib.commands.identify_poses import judged_fit

SHARE, SAME_TORQUE, SECONDS = 0.95, 1e-4, 20.0


def main() -> int:
    """Draw, identify, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="number of the first draw")
    given = parser.parse_args()
    inside, joints, torque, ratios = 0, 0, 0.0, list[float]()
    for seed in range(given.seed, given.seed + given.draws):
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as scratch:
            drawn = draw(seed, Path(scratch))
            found = outcome(drawn, seed)
        inside, joints = inside + int(found.inside.sum()), joints + len(found.inside)
        torque = max(torque, found.pinocchio)
        acting = found.size > 1e-6
        ratios += (found.error / np.maximum(found.bound, 1e-12))[acting].tolist()
        print(
            f"{seed:>4}: {len(found.inside)} joints, {len(found.judged.fit.readings):>3} readings, "
            f"{'both sides' if drawn.both_sides else 'one side  '}, {'gains' if drawn.gains else '     '} "
            f"error/bound {np.round((found.error / np.maximum(found.bound, 1e-12))[acting], 2)}, error "
            f"{np.round(found.error[acting], 3)} of {np.round(found.size[acting], 1)} N·m, "
            f"{time.monotonic() - began:.1f} s",
            flush=True,
        )
    print(f"{inside} of {joints} joints within their bound; error over bound: median {np.median(ratios):.2f}")
    print(f"Pinocchio in the written URDF: at most {torque:.2g} N·m from the fitted gravity")
    wrong = [f"only {inside} of {joints} within their bound"] * (inside < SHARE * joints)
    wrong += [f"Pinocchio has torques {torque:.2g} N·m away"] * (torque > SAME_TORQUE)
    for name, model, table in real_poses(Path(tempfile.mkdtemp())):
        began = time.process_time()  # the machine may be shared
        judged = judged_fit(stated_model(str(model)), [table], [], {}, None)
        took, held, own = time.process_time() - began, judged.held_out, judged.nominal
        print(
            f"{name}: {len(judged.fit.readings)} poses in {took:.1f} s; held-out RMS {np.round(held, 2)} N·m, with the "
            f"model's own moments {np.round(own, 2)}"
        )
        wrong += [f"{name} took {took:.1f} s"] * (took > SECONDS)
    return exit_status(wrong)


if __name__ == "__main__":
    sys.exit(main())
