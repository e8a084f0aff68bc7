"""Makes blind-check cases in a process of its own: `python -m sim_gap.blind.cases --out DIR --labels DIR`."""

import argparse
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armlink.recording.csv_text import write_numbers
from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, compile_arm, inverse, mjcf
from sim_gap.blind.plant.plant import simulate
from sim_gap.blind.plant.sensors import columns_at, record
from sim_gap.blind.recipe import CaseDrawing, CaseRecipe, draw, label, recipes
from sim_gap.blind.true_arm import Log

BAND_HZ = 6.0
"""Band in which a gap counts [Hz]."""
REVERSAL_SPEED = 0.02
"""Speed over which nominal friction changes sign [rad/s]."""
VISIBLE_RATIO, VISIBLE_LEAST = 3.0, 0.08
"""Least factor on some held-out gap, and least increase of it [N·m], by a visible effect."""
MOVING = 0.03
"""Motor channels count only above this speed [rad/s]: at rest friction is undetermined."""


def gap(arm: BenchArm, columns: dict[str, Array]) -> dict[str, list[float]]:
    """RMS [N·m] per joint of `tau`, `tau_motor` and `tau_cmd` against the nominal model, below 6 Hz."""
    from scipy.signal import butter, sosfiltfilt

    t = np.arange(columns["t"][0], columns["t"][-1], 1.0 / RATE)
    even = {k: columns_at(t, columns["t"], columns[k]) for k in ("q", "tau", "tau_motor", "tau_cmd")}
    low = butter(4, BAND_HZ, fs=RATE, output="sos")
    q = sosfiltfilt(butter(4, 15.0, fs=RATE, output="sos"), even["q"], axis=0)
    v = np.gradient(q, 1.0 / RATE, axis=0)
    a = np.gradient(v, 1.0 / RATE, axis=0)
    motor = inverse(compile_arm(arm), q, v, a)
    link = motor - arm.armature * a
    motor = motor + arm.damping * v + arm.frictionloss * np.tanh(v / REVERSAL_SPEED)
    out = {}
    for channel, model in (("tau", link), ("tau_motor", motor), ("tau_cmd", motor)):
        rest = sosfiltfilt(low, even[channel] - model, axis=0)[100:-100]
        counts = (np.abs(v[100:-100]) > MOVING) if channel != "tau" else np.ones(rest.shape, bool)
        out[channel] = [
            float(np.sqrt((x[c] ** 2).mean())) if c.any() else 0.0 for x, c in zip(rest.T, counts.T, strict=True)
        ]
    return out


def largest_fall(before: dict[str, list[float]], after: dict[str, list[float]]) -> dict[str, Any]:
    """Channel and joint at which the effect's absence lowers the gap most, with both values and the shrink."""
    falls = [
        (b - a, channel, j, b, a)
        for channel in before
        for j, (b, a) in enumerate(zip(before[channel], after[channel], strict=True))
    ]
    _, channel, j, b, a = max(falls)
    return {"channel": channel, "joint": f"joint_{j + 1}", "before": b, "after": a, "shrink": 1.0 - a / max(b, 1e-9)}


def is_visible(fall: dict[str, Any], least: float = VISIBLE_LEAST) -> bool:
    """Whether the gap caused by an effect exceeds that of every arm clearly."""
    return bool(fall["before"] > VISIBLE_RATIO * fall["after"] and fall["before"] - fall["after"] > least)


Values = TypeVar("Values")
TRAIN_S, HELDOUT_S, RATE = 120.0, 40.0, 250.0
ROUNDS = 4
"""Number of drawings of a case that does not show its effects."""
FOLLOWED = 0.3
"""Largest deviation from the commanded trajectory [rad] of an arm under control."""
DECIMALS = {"t": 6, "q": 7, "dq": 6, "q_cmd": 7}


def make_cases(
    wanted: Sequence[CaseRecipe],
    out: Path,
    labels: Path,
    train_s: float = TRAIN_S,
    heldout_s: float = HELDOUT_S,
    rate: float = RATE,
) -> None:
    """Draw, simulate and write cases: `out/case_XXXX/{sim.xml,train.csv,heldout.csv}`, `labels/case_XXXX.json`.

    A case is drawn again if its effects do not show in the held-out data or its arm was not under control, and left out
    if no arm shows it.
    """
    labels.mkdir(parents=True, exist_ok=True)
    todo = dict.fromkeys(wanted, 0)
    for last in (*[False] * (ROUNDS - 1), True):
        drawings = [d for recipe, first in todo.items() if (d := draw(recipe, train_s, heldout_s, first)) is not None]
        if not drawings:
            return
        logs = iter(simulate([run for d in drawings for run in (d.heldout, *d.without)]))
        seen = [_judged(drawing, [next(logs) for _ in range(1 + len(drawing.without))], rate) for drawing in drawings]
        good = [(d, judged) for d, judged in zip(drawings, seen, strict=True) if last or judged.good]
        done = set()
        for (drawing, judged), train in zip(good, simulate([d.train for d, _ in good]) if good else (), strict=True):
            steady = _steady(drawing.train.command, train)
            if last or steady:
                judged = replace(judged, good=judged.good and steady)
                _write(drawing, judged, train, out / drawing.recipe.name, labels, rate)
                done.add(drawing.recipe.name)
        todo = {d.recipe: d.attempt + 1 for d in drawings if d.recipe.name not in done}
        if not todo:
            return


@dataclass(frozen=True)
class Judged:
    """A case's held-out recording, the gaps with and without its effects, and whether it can be used."""

    heldout: dict[str, Array]
    gaps: dict[str, Any]
    good: bool


def _judged(drawing: CaseDrawing, logs: list[Log], rate: float) -> Judged:
    """Compare the held-out recording with those without each effect."""
    runs = (drawing.heldout, *drawing.without)
    recordings = [
        record(run.truth, log, rate, drawing.columns["velocity"], run.command, _random(drawing, 1))
        for run, log in zip(runs, logs, strict=True)
    ]
    gaps = [gap(drawing.nominal, recording) for recording in recordings]
    recorded = [
        _chosen(each, drawing.columns) for each in gaps
    ]  # channels that are not recorded do not make a case clear
    others = recorded[1 : 1 + len(drawing.drawn)]
    if drawing.recipe.several:  # the others hold one effect each
        falls = [largest_fall(alone, recorded[-1]) for alone in others]
    else:
        falls = [largest_fall(recorded[0], less) for less in others]
    steady = all(_steady(run.command, log) for run, log in zip(runs, logs, strict=True))
    found = {"with": gaps[0], "without": gaps[-1], "falls": falls}
    return Judged(recordings[0], found, steady and (bool(drawing.recipe.several) or all(is_visible(f) for f in falls)))


def _steady(command: Array, log: Log) -> bool:
    """Whether the controller followed its trajectory without oscillation."""
    oscillating = np.abs(np.diff(log.motor, 2, axis=0)).mean(0) > 0.25 * log.motor.std(0) + 0.1
    return bool(np.abs(log.position - command).max() < FOLLOWED and not oscillating.any())


def _write(drawing: CaseDrawing, judged: Judged, train: Log, folder: Path, labels: Path, rate: float) -> None:
    run, name = drawing.train, drawing.recipe.name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sim.xml").write_text(mjcf(drawing.nominal), encoding="utf-8")
    columns = record(run.truth, train, rate, drawing.columns["velocity"], run.command, _random(drawing, 0))
    write_csv(folder / "train.csv", _chosen(columns, drawing.columns))
    write_csv(folder / "heldout.csv", _chosen(judged.heldout, drawing.columns))
    truth = {**label(drawing), "gap": judged.gaps, "clear": judged.good}
    (labels / f"{name}.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")


def _random(drawing: CaseDrawing, number: int) -> np.random.Generator:
    return np.random.default_rng([*drawing.recipe.seed, drawing.attempt, 1000 + number])


def _chosen(columns: dict[str, Values], wanted: dict[str, bool]) -> dict[str, Values]:
    dropped = {name for name, key in (("q_cmd", "position_command"), ("tau_cmd", "torque_command")) if not wanted[key]}
    return {name: values for name, values in columns.items() if name not in dropped}


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as in docs/formats.md: `t`, then `name_1` … `name_n` of each channel."""
    flat: dict[str, Array] = {}
    for name, values in columns.items():
        rounded = np.round(values, DECIMALS.get(name, 5)) + 0.0
        flat |= {name: rounded} if values.ndim == 1 else {f"{name}_{j + 1}": x for j, x in enumerate(rounded.T)}
    with path.open("wb") as file:
        write_numbers(file, flat)


Make = Callable[[Sequence[Any], Path, Path, float, float], None]
"""Makes cases: recipes, folder of the cases, folder of the labels, seconds of training and of held-out motion."""


def parse_words(description: str) -> argparse.Namespace:
    """Options that `gap bench` gives to a maker of cases."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, default=150)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--effects", default="")
    parser.add_argument("--train-s", type=float, default=TRAIN_S)
    parser.add_argument("--heldout-s", type=float, default=HELDOUT_S)
    return parser.parse_args()


def make_all(make: Make, wanted: Sequence[Any], given: argparse.Namespace) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    size = max(1, min(12, -(-len(wanted) // given.workers)))  # simulated together in one process
    with ProcessPoolExecutor(given.workers, mp_context=get_context("spawn")) as pool:
        jobs = [
            pool.submit(make, wanted[first : first + size], given.out, given.labels, given.train_s, given.heldout_s)
            for first in range(0, len(wanted), size)
        ]
        for job in jobs:
            job.result()


def main() -> None:
    given = parse_words(str(__doc__))
    low, _, high = given.effects.partition("-")
    make_all(make_cases, recipes(given.seed, given.cases, (int(low), int(high)) if high else None), given)
    (given.labels / "withhold.txt").write_text("\n".join(draw_withheld(given.labels)), encoding="utf-8")


def draw_withheld(labels: Path, each: int = 2) -> list[str]:
    """Lines "case effect": the first `each` single-effect cases of every effect that the recording can separate."""
    chosen: dict[str, list[str]] = {}
    for path in sorted(labels.glob("*.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        if truth["kind"] == "single" and not truth["effects"][0]["undecided"]:
            cases = chosen.setdefault(truth["effects"][0]["effect"], [])
            if len(cases) < each:
                cases.append(truth["case"])
    return [f"{case} {effect}" for effect in sorted(chosen) for case in chosen[effect]]


if __name__ == "__main__":
    main()
