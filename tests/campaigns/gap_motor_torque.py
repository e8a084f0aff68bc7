"""Diagnosis of drawn arms without torque sensors from motor torque alone: torque constants, friction, rotors, lag.

    .venv/bin/python tests/campaigns/gap_motor_torque.py --arms 10

Arms are OpenArm's model with hidden drives (tests/sim_gap/motor_torque_arms.py). An arm takes half a minute. With
--zeros 0.03 the position zeros are as on an arm out of the box. Exit status 1 where a bound is broken.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from importlib.resources import as_file, files
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "sim_gap"))
from motor_torque_arms import Drawn, draw, names_of_joints, recording, shares, truths

from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.better_model.export import write_model

LENGTHS = 60.0, 25.0
"""Training and held-out recordings [s]."""
CLEAR = 2.0
"""An effect at a joint has to be named from this multiple of the joint's noise on."""
COVER, OFF, NAMED, FALSE = 0.90, 0.10, 0.90, 0.03
"""Least share of the intervals that hold, relative error of a parameter that counts as off, least share of clear
effects named, and largest share of false causes among those above CONFIDENT."""
CONFIDENT = 0.8


def judge(truth: Drawn, answer: Diagnosis, seed: int, counts: Counter[str]) -> str:
    """Count what is right and wrong in an answer, and describe it in a line."""
    joints, known = names_of_joints(), truths(truth)
    told = {(c.effect, j): c for c in (*answer.causes, *answer.minor) for j in c.joints}
    clear = shares(truth, seed + 1, LENGTHS[1])
    lines = []
    for effect, values in known.items():
        for j, name in enumerate(joints):
            if clear[effect][j] > CLEAR * answer.noise_floor[j]:
                same = [effect, *(("actuator.delay",) if effect == "actuator.lag" else ())]
                found = any((each, name) in told for each in same)
                counts["clear"] += 1
                counts["named"] += found
                lines += [] if found else [f"{effect} {name[-6:]} not named"]
            cause = told.get((effect, name))
            if cause is None:
                continue
            value = next(iter(cause.parameters[name].values()))
            inside = value.low <= values[j] <= value.high
            size = abs(values[j] - 1.0) if effect == "actuator.gain" else abs(values[j])
            loud = clear[effect][j] > CLEAR * answer.noise_floor[j]
            kind = "k" if effect == "actuator.gain" else "other"
            counts[f"{kind} given"] += 1
            counts[f"{kind} inside"] += inside
            counts["loud"] += loud
            counts["off"] += loud and abs(value.value - values[j]) > OFF * size
            if not inside:
                limits = f"{value.low:.4g} to {value.high:.4g}"
                lines.append(f"{effect} {name[-6:]} {value.value:.4g} ({limits}), true {values[j]:.4g}")
            if kind == "k":
                counts["k within 2 %"] += abs(value.value / values[j] - 1.0) < 0.02
    sure = [cause for cause in answer.causes if cause.confidence > CONFIDENT]
    fine = {*known, "friction.asymmetric", "torque.offset", "position.offset", "link.mass_moment", "timing.delay"}
    fine |= {"transmission.ripple", "actuator.delay"}
    false = [cause.effect for cause in sure if cause.effect not in fine]
    counts["sure"] += len(sure)
    counts["false"] += len(false)
    lines += [f"FALSE {effect}" for effect in false]
    lines += [
        f"also {c.effect} {c.confidence:.2f}"
        for c in answer.causes
        if c.effect not in known and c.effect != "torque.offset"
    ]
    return "; ".join(lines)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=10)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--zeros", type=float, default=0.002, help="standard deviation of the position zeros [rad]")
    parser.add_argument("--masses", type=float, default=0.01, help="error of each link's mass, as a share")
    parser.add_argument("--no-command", action="store_true", help="motor torque alone, without commands")
    given = parser.parse_args()
    counts = Counter[str]()
    with as_file(files("sim_bus.arms") / "openarm.xml") as path, tempfile.TemporaryDirectory() as scratch:
        for seed in range(given.first, given.first + given.arms):
            began = time.process_time()
            truth = draw(seed, zeros=given.zeros, masses=given.masses)
            command = not given.no_command
            made = [recording(truth, 10 * seed + k, s, command=command) for k, s in enumerate(LENGTHS)]
            answer = diagnose(str(path), made[:1], made[1:])
            text = judge(truth, answer, 10 * seed, counts)
            if answer.internals is not None:
                out = Path(scratch) / "model.xml"
                write_model(answer.internals.model, answer.internals.estimate, out)
                mujoco.MjModel.from_xml_path(str(out))
            left = np.max(np.array(answer.heldout_after) / np.array(answer.heldout_before))
            print(
                f"{seed:>3} {answer.verdict}, {left:.0%} left, {time.process_time() - began:.0f} s: {text}", flush=True
            )
    return tell(counts)


def tell(counts: Counter[str]) -> int:
    """The whole, and the exit status."""

    def share(part: str, whole: str) -> float:
        return counts[part] / counts[whole] if counts[whole] else 1.0

    print(
        f"torque constants: {counts['k inside']} of {counts['k given']} intervals hold, {counts['k within 2 %']} within"
        f" 2 %; others: {counts['other inside']} of {counts['other given']} hold; {counts['named']} of"
        f" {counts['clear']} clear effects named, {counts['off']} of {counts['loud']} of them more than 10 % off;"
        f" {counts['false']} of {counts['sure']} causes above {CONFIDENT} false"
    )
    held = min(share("k inside", "k given"), share("other inside", "other given"))
    return int(held < COVER or share("named", "clear") < NAMED or (counts["false"] / max(counts["sure"], 1)) > FALSE)


if __name__ == "__main__":
    sys.exit(main())
