"""Hard cases one at a time, swept with and without the mass on the simulated bus, and judged (issue 5's second demand).

    .venv/bin/python tests/campaigns/hard_cases.py --seeds 1 4

An arm and case takes a quarter of a minute. Exit status 1 where a fit is wrong and does not say so.
"""

import argparse
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from hard_cases import CASES, drawn_hard_arm, hard_arm, judge, sweep_case


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 4), metavar=("FIRST", "LAST"))
    parser.add_argument("--joints", type=int, help="simpler arms of so many joints; default: drawn ones of 3 to 7")
    parser.add_argument("--cases", nargs="+", default=CASES)
    given = parser.parse_args()
    failed, scores = 0, list[np.ndarray]()
    for case in given.cases:
        for seed in range(given.seeds[0], given.seeds[1] + 1):
            began = time.monotonic()
            try:
                easy = given.joints is not None
                arm, simulated = hard_arm(case, seed, given.joints) if easy else drawn_hard_arm(case, seed)
                with tempfile.TemporaryDirectory() as scratch:
                    swept = sweep_case(case, arm, simulated, Path(scratch))
                    outcome = judge(swept)
            except Exception as error:  # a sweep that fails is a result, too
                failed += 1
                print(f"{case:>10} {seed}: FAILED {type(error).__name__}: {error}", flush=True)
                traceback.print_exc()
                continue
            failed += bool(outcome.wrong)
            if not outcome.named:
                scores.append(outcome.scores)
            lost = ", ".join(f"{joint}.{parameter}" for joint, parameter in sorted(outcome.fit.reasons)) or "none"
            found = " | ".join(finding.text for finding in outcome.fit.findings) or "nothing"
            print(
                f"{case:>10} {seed}: doubtful: {' '.join(outcome.named) or 'none'}; found: {found}; errors up to"
                f" {outcome.scores.max(initial=0.0):.1f} standard deviations, {np.mean(outcome.scores < 1.96):.0%} of"
                f" {len(outcome.scores)} within 95 %; slips {swept.slips}; unobservable: {lost};"
                f" {time.monotonic() - began:.0f} s; {'; '.join(outcome.wrong) or 'ok'}",
                flush=True,
            )
    every = np.concatenate(scores) if scores else np.zeros(0)
    print(f"where no joint is doubtful {np.mean(every < 1.96):.1%} of {len(every)} intervals hold; {failed} wrong")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
