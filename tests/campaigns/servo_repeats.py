"""Position-only diagnoses of one arm: do bands hold its other motion, and do two recordings give the same parameters?

    python tests/campaigns/servo_repeats.py [--arms 10] [--beyond]
    python tests/campaigns/servo_repeats.py --sim MODEL.xml --recordings REC … [--parts 5] [--others 4]

Simulated two-joint servo arms with drawn gain, friction and damping are diagnosed twice, from different recordings;
the recordings of a real arm are dealt into parts, and each is diagnosed with the next ones held out. With `--beyond`
the held-out motion is 1.7 times as fast and 1.5 times as wide as that of the training, and torque limits, which the
model does not state, are 1.0 to 2.5 times what that asks for.

Printed are, of each, the share of the held-out motion within the 90 % band, what draws of the parameters leave of the
training motion over what the fit leaves, in the median and of nine in ten, and of every two diagnoses of an arm the
parameters whose values lie in each other's 95 % intervals, whose intervals overlap, and whose difference is within that
of two such intervals, the root of the sum of their squares. Exit status 1 if the bands hold less than 85 or more than
95 % over all joints, or less than 90 % of the differences are such.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from itertools import chain, combinations
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "sim_gap"))
from servo_arm import model_text, record, written

from armlink.recording.files import load_recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.position_gap.fit import rms_on
from sim_gap.position_gap.training.spread import draw

HELD, APART = (0.85, 0.95), 0.9
DRAWS = 100


def intervals(answer: Diagnosis) -> dict[tuple[str, str, str], tuple[float, float, float]]:
    """Value and ends of the interval by effect, joint and parameter."""
    return {
        (cause.effect, joint, name): (one.value, one.low, one.high)
        for cause in (*answer.causes, *answer.minor)
        for joint, values in cause.parameters.items()
        for name, one in values.items()
    }


def simulated(arms: int, seed: int, beyond: bool) -> Iterator[tuple[str, list[Diagnosis]]]:
    """Both diagnoses of each simulated arm."""
    random = np.random.default_rng(seed)
    for number in range(arms):
        kp, friction, damping = random.uniform(8.0, 25.0), random.uniform(0.05, 0.4), random.uniform(0.4, 1.2)
        real = model_text(kp=kp, friction=friction, damping=damping)
        with tempfile.TemporaryDirectory() as folder:
            sim = written(Path(folder), model_text(kp=120.0, friction=0.0))
            train = [record(real, 1000 * number + k, 35.0) for k in (1, 2)]
            other = [record(real, 1000 * number + 9, 28.0)]
            if beyond:
                asked_for = kp * np.max([np.abs(one.position_command - one.position).max(0) for one in train], axis=0)
                limits = random.uniform(1.0, 2.5) * asked_for
                limited = model_text(kp=kp, friction=friction, damping=damping, limits=limits)
                other = [record(limited, 1000 * number + 9, 28.0, wide=1.5, fast=1.7)]
            yield f"arm {number} (kp {kp:.1f}, {friction:.2f} N·m)", [diagnose(sim, [one], other) for one in train]


def recorded(asked: argparse.Namespace) -> Iterator[tuple[str, list[Diagnosis]]]:
    """The diagnoses of the parts of a real arm's recordings."""
    parts = [[load_recording(path) for path in asked.recordings[k :: asked.parts]] for k in range(asked.parts)]
    answers = []
    for k, train in enumerate(parts):
        others = chain.from_iterable(parts[(k + 1 + n) % asked.parts] for n in range(asked.others))
        answers.append(diagnose(asked.sim, train, list(others)))
    yield asked.sim.parent.name, answers


def drawn(answer: Diagnosis) -> np.ndarray:
    """Median and 90 % quantile of what draws leave of the training motion over what the fit leaves, (2, J)."""
    found = answer.internals
    data, names = found.search.data, list(found.sim.arm.names)
    points = []
    for row in draw(found.search, found.fit, found.spread, DRAWS, reach=found.band.reach):
        point = {name: values.copy() for name, values in found.fit.point.items()}
        for label, value in row.items():
            joint, _, name = label.rpartition(".")
            if joint in names:
                point[name][names.index(joint)] = value
            else:
                point[label][:] = value
        points.append(point)
    left = np.stack([rms_on(data, point) for point in [found.fit.point, *points]])
    return np.quantile(left[1:] / left[0], [0.5, 0.9], axis=0)


def compared(one: Diagnosis, two: Diagnosis) -> Iterator[tuple[str, tuple[bool, bool], bool, bool]]:
    """Of each parameter of both: a line, which value is in the other's interval, overlap, whether it is one value."""
    first, second = intervals(one), intervals(two)
    for key in sorted(first.keys() & second.keys()):
        (a, a_low, a_high), (b, b_low, b_high) = first[key], second[key]
        half = np.hypot(*((a_high - a, b - b_low) if b > a else (a - a_low, b_high - b)))
        line = f"{key} {a:.4g} ({a_low:.4g} to {a_high:.4g}), {b:.4g} ({b_low:.4g} to {b_high:.4g})"
        inside = a_low <= b <= a_high, b_low <= a <= b_high
        yield line, inside, max(a_low, b_low) <= min(a_high, b_high), bool(abs(a - b) <= half)


def main() -> int:
    """Diagnose, compare, print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--arms", type=int, default=10)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--beyond", action="store_true")
    options.add_argument("--sim", type=Path)
    options.add_argument("--recordings", type=Path, nargs="+")
    options.add_argument("--parts", type=int, default=2)
    options.add_argument("--others", type=int, default=1, help="parts that are held out")
    asked = options.parse_args()
    holds, inside, overlap, alike = [], [], [], []
    for name, answers in recorded(asked) if asked.sim else simulated(asked.arms, asked.seed, asked.beyond):
        for line, within, touch, same in (each for pair in combinations(answers, 2) for each in compared(*pair)):
            inside += within
            overlap.append(touch)
            alike.append(same)
            if not same:
                print(f"  apart: {line}")
        own = [answer.band.holds for answer in answers if answer.band is not None]
        holds += own
        print(name, answers[0].verdict, "bands hold", *(np.round(each, 3) for each in own), flush=True)
        for median, most in map(drawn, answers):
            print(
                "  draws leave",
                np.round(median, 2),
                "times as much, nine in ten at most",
                np.round(most, 2),
                flush=True,
            )
    share = float(np.mean(holds))
    print(f"90 % bands hold {share:.1%} of the held-out motion")
    print(
        f"{np.mean(alike):.1%} of {len(alike)} differences within those of two intervals, {np.mean(overlap):.1%} of "
        f"the intervals overlap, {np.mean(inside):.1%} of the values in the other's"
    )
    return int(not HELD[0] <= share <= HELD[1] or np.mean(alike) < APART)


if __name__ == "__main__":
    sys.exit(main())
