"""Hard cases one at a time, swept with and without the mass on the simulated bus, and judged.

    .venv/bin/python tests/campaigns/hard_cases.py --seeds 1 20

An arm and case takes about a minute. Exit status 1 where a fit is wrong and does not say so.
"""

import argparse
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_arms import BUNDLED
from hard_cases import CASES, JOINT, asked_hard_arm, judge, sweep_case

from calib.motion.encoder_check import EncoderFault


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--only-random", action="store_true", help="leave the bundled arms out")
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--keep", type=Path, help="directory that keeps the data sets")
    given = parser.parse_args()
    arms = [str(seed) for seed in range(given.seeds[0], given.seeds[1] + 1)]
    arms = arms if given.only_random else [*arms, *BUNDLED]
    failed, scores = 0, list[np.ndarray]()
    for case in given.cases:
        for which in arms:
            began = time.monotonic()
            arm, simulated = asked_hard_arm(case, which)
            try:
                with tempfile.TemporaryDirectory() as scratch:
                    out = given.keep / case / which if given.keep else Path(scratch)
                    swept = sweep_case(case, arm, simulated, out)
                    outcome = judge(swept)
            except EncoderFault as fault:
                right = case == "encoder" and str(fault).startswith(f"{arm.joint_names[JOINT]}: ")
                failed += not right
                print(f"{case:>10} {which}: swept no further: {fault}; {'ok' if right else 'wrong'}", flush=True)
                continue
            except Exception as error:  # a sweep that fails is a result, too
                failed += 1
                print(f"{case:>10} {which}: FAILED {type(error).__name__}: {error}", flush=True)
                traceback.print_exc()
                continue
            failed += bool(outcome.wrong)
            scores.append(outcome.scores)
            lost = ", ".join(f"{joint}.{parameter}" for joint, parameter in sorted(outcome.fit.reasons)) or "none"
            found = " | ".join(finding.text for finding in outcome.fit.findings) or "nothing"
            print(
                f"{case:>10} {which}: doubtful: {' '.join(outcome.named) or 'none'}; found: {found}; errors up to"
                f" {outcome.scores.max(initial=0.0):.1f} standard deviations, {np.mean(outcome.scores < 1.96):.0%} of"
                f" {len(outcome.scores)} within 95 %; slips {swept.slips}; unobservable: {lost};"
                f" {time.monotonic() - began:.0f} s; {'; '.join(outcome.wrong) or 'ok'}",
                flush=True,
            )
    every = np.concatenate(scores) if scores else np.zeros(0)
    print(f"of joints that are not doubtful {np.mean(every < 1.96):.1%} of {len(every)} intervals hold; {failed} wrong")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
