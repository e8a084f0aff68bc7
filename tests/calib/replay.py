"""Recorded runs of the observer with what it made of them: every change of its output shows as a difference.

python tests/calib/replay.py --record   makes the recordings anew (tests/calib/replays/*.csv.gz) and the references
python tests/calib/replay.py --write    makes the references (*.txt) anew from the recordings; look at the difference
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fast_arm import FastArm

from armlink.arm_file import load_arm
from armlink.recording.files import load_recording, save_recording
from armlink.recording.recording import Recording
from calib.observer.observer import Observer

FOLDER = Path(__file__).parent / "replays"
DIGITS = 5
"""Of every number in a reference: what the last bits of the linear algebra do is no change."""


def drift(arm: FastArm, t: float) -> None:
    """Joint 3: gain and offset, a step."""
    if t > 60:
        arm.gain[2], arm.offset[2] = 1.03, 0.3


def payload(arm: FastArm, t: float) -> None:
    """1.2 kg from 50 s to 110 s."""
    if 50 < t < 110:
        arm.carry(1.2, np.array([0.04, -0.08, 0.1]))
    else:
        arm.put_down()


def collision(arm: FastArm, t: float) -> None:
    """Something pushes for two stops, later a hand leans on the arm for half a minute."""
    pushed, leant = 50 < t < 54, 90 < t < 120
    arm.push = (lambda q: 8.0 * np.sin(3.0 * q)) if pushed or leant else None


def two(arm: FastArm, t: float) -> None:
    """A step on joint 2 and a ramp on joint 4."""
    arm.offset[1] = 0.5 * (t > 50)
    arm.gain[3] = 1 + 0.02 * np.clip((t - 50) / 60, 0.0, 1.0)


RUNS: dict[str, tuple[Callable[[FastArm, float], None], float]] = {
    "drift": (drift, 150.0),
    "payload": (payload, 160.0),
    "collision": (collision, 160.0),
    "two": (two, 240.0),
}


def record(name: str) -> None:
    """Make a recording anew."""
    change, seconds = RUNS[name]
    arm = FastArm("sarcos", seed=sorted(RUNS).index(name))
    pieces = []
    while arm.t < seconds:
        change(arm, arm.t)
        pieces += list(arm.samples(1e-3))
    t, position, torque = (np.concatenate(column)[::2] for column in zip(*pieces, strict=True))
    recording = Recording(t=t - t[0], position=position.round(6), torque=torque.round(4), names=arm.arm.names)
    save_recording(recording, FOLDER / f"{name}.csv.gz")


def replay(name: str) -> list[str]:
    """What the observer makes of a recording: a line an event and, every half minute, a line a joint."""
    recording = load_recording(FOLDER / f"{name}.csv.gz")
    arm = FastArm("sarcos", seed=sorted(RUNS).index(name))
    observer = Observer.at_rest(arm.arm, arm.model, arm.covariance, 1e-3 * arm.rated)
    assert load_arm("sarcos").joint_names == recording.names
    assert recording.torque is not None
    lines, told = [f"# {name}: {RUNS[name][0].__doc__}"], 30.0
    for t, position, torque in zip(recording.t.tolist(), recording.position, recording.torque, strict=True):
        said = observer.handle(t, position, torque)
        lines += [f"{event.t:.2f} {event.kind} {event.joint or '-'} {text(event.evidence)}" for event in said]
        if t >= told:
            told += 30.0
            known = observer.estimate()
            for j, joint in enumerate(recording.names):
                numbers = (known.gain[j], known.gain_std[j], known.offset[j], known.offset_std[j])
                lines.append(f"{t:.2f} estimate {joint} {' '.join(map(text, numbers))} {known.accepted[j]}")
    return lines


def text(value: Any) -> str:
    """A value in so many digits."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(text, value)) + "]"
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


def main() -> int:
    """Write references."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    for name in RUNS:
        if given.record:
            record(name)
        if given.record or given.write:
            (FOLDER / f"{name}.txt").write_text("\n".join(replay(name)) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
