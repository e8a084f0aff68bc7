"""Campaign: every call of the daemon to its dependencies fails once, over a simulated hour.

python tests/campaigns/fault_injection.py [--stride 40] [--runs 40] [--rests 0 10] [--minutes 60] [--bursts]

Dependencies are record store (statements, commits), journal, disk of the recordings, pipe to the bus process, and the
socket of systemd. In run r the calls fail whose number leaves r when divided by the stride, so that all runs together
fail each call once; with --bursts the runs fail 1 to 200 calls in a row, of one dependency after the other. In the hour
nine joints drift and are recalibrated. Exit status 1 if the daemon ends, an event is lost, state or record is wrong
later than 5 s after a failure, a sign of life is missing, or a joint is neither recalibrated nor said to be undecided.
"""

import argparse
import json
import logging
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))

from failing_calls import DEPENDENCIES, FailingDaemon

BURSTS = (1, 2, 5, 10, 20, 50, 100, 200)
QUIET_MINUTES = 4.0
"""At the end, without failures."""
RECALIBRATED = 0.15
"""What a joint may be off by at the end [N·m], half of one drift, unless the observer said that it cannot decide."""
DECIDED = ("recalibration", "undecided")


def hour(fails: Callable[[str, int], bool], minutes: float) -> tuple[FailingDaemon, list[str]]:
    """Drifts of one joint after the other every six minutes while calls fail; what was wrong."""
    drifts = np.random.default_rng(7)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        daemon = FailingDaemon(Path(folder), fails, patch)
        for number in range(round((minutes - QUIET_MINUTES) / 6)):
            joint = number % daemon.fast.n
            daemon.run(60)
            daemon.fast.offset[joint] += drifts.choice([-0.3, 0.3])
            daemon.fast.gain[joint] *= 1.02
            daemon.run(300)
        daemon.failing.fails = lambda dependency, count: False
        daemon.run(60 * QUIET_MINUTES)
        wrong = daemon.wrong + [f"lost: {each}" for each in daemon.lost()]
        off = np.abs(daemon.fast.error()[1])
        said = {event.joint: event.kind for event in daemon.view.events(limit=1_000_000) if event.kind in DECIDED}
        names = daemon.arm.joint_names
        left = [names[j] for j in np.flatnonzero(off > RECALIBRATED) if said.get(names[j]) != "undecided"]
        wrong += [f"{name} is off by {off[names.index(name)]:.2f} N·m at the end" for name in left]
        open_ones = [each.id for each in daemon.view.proposals() if each.state == "approved"]
        wrong += [f"proposal {number} is left without an outcome" for number in open_ones]
        wrong += ["a write to a controller is left half done"] * (daemon.store.unfinished_write(daemon.arm) is not None)
        return daemon, wrong


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stride", type=int, default=40)
    parser.add_argument("--runs", type=int, default=0, help="only this many of the runs, evenly spread")
    parser.add_argument(
        "--rests",
        type=int,
        nargs=2,
        metavar=("FROM", "TO"),
        help="only the runs from one to before another, of bursts by their place",
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--bursts", action="store_true")
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    runs: list[tuple[str, Callable[[str, int], bool]]]
    if given.bursts:
        runs = [
            (
                f"{which}, {burst} in a row",
                lambda name, count, of=which, row=burst: name == of and count % (40 + 2 * row) < row,
            )
            for burst in BURSTS
            for which in DEPENDENCIES
        ]
        runs = runs if given.rests is None else runs[slice(*given.rests)]
    else:
        kept = np.linspace(0, given.stride, given.runs or given.stride, endpoint=False).astype(int).tolist()
        kept = kept if given.rests is None else range(*given.rests)
        runs = [(f"rest {rest}", lambda name, count, of=rest: count % given.stride == of) for rest in kept]
    calls, failed, bad = dict.fromkeys(DEPENDENCIES, 0), dict.fromkeys(DEPENDENCIES, 0), 0
    for what, fails in runs:
        began = time.process_time()
        daemon, wrong = hour(fails, given.minutes)
        for name in DEPENDENCIES:
            calls[name] = max(calls[name], daemon.failing.calls[name])
            failed[name] += daemon.failing.failed[name]
        bad += bool(wrong)
        print(
            f"{what}: {sum(daemon.failing.failed.values())} failures, {time.process_time() - began:.0f} s", flush=True
        )
        for line in wrong[:10]:
            print(f"FAILED: {what}: {line}", flush=True)
    print(json.dumps({"runs": len(runs), "calls_an_hour": calls, "failed": failed, "runs_wrong": bad}))
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
