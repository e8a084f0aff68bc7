"""Makes blind-check cases in a process of its own: `python -m sim_gap.blind.cases '{"out": …}'`, see `make_cases`."""

import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from armlink.recording.csv_text import write_numbers
from gcomp.arrays import Array
from sim_bus.effects.registry import imperfections
from sim_gap.blind.arms import BenchArm, compile_arm, inverse, mjcf
from sim_gap.blind.effects.drawn_effect import DrawnEffect, Values
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant import Log, PlantRun, TrueArm, columns_at, controller_bandwidth, record, simulate, true_arm
from sim_gap.blind.recipe import CaseDrawing, CaseRecipe, draw, recipes, servo_recipes
from sim_gap.blind.servo_plant import ServoRun, record_servos, simulate_servos

RECORDED_HZ, SERVO_HZ = 250.0, (50.0, 100.0)
"""Rates of the recordings with torques, and of positions alone [Hz]."""
BAND_HZ = 6.0
"""Band in which a gap counts [Hz]."""
REVERSAL_SPEED = 0.02
"""Speed over which nominal friction changes sign [rad/s]."""
VISIBLE_RATIO, VISIBLE_LEAST, VISIBLE_COUNTS = 3.0, 0.08, 2.0
"""Least factor on some held-out gap, and least increase of it by a visible effect: [N·m], and of positions alone counts
of the encoder."""
MOVING = 0.03
"""Motor channels count only above this speed [rad/s]: at rest friction is undetermined."""
ROUNDS = 4
"""Number of drawings of a case that does not show its effects."""
FOLLOWED, SERVO_FOLLOWED = 0.3, 0.6
"""Largest deviation from the command [rad] of an arm under control, and of one with servos."""
SETTLING_S = 1.0
"""Time at the start of a run of positions alone that is not judged [s]."""
DECIMALS = {"t": 6, "q": 7, "dq": 6, "q_cmd": 7}
"""Of a column in a file; 5 of the others."""
Columns = dict[str, Array]
Gap = dict[str, list[float]]


def gap(arm: BenchArm, columns: Columns) -> Gap:
    """RMS [N·m] per joint of `tau`, `tau_motor` and `tau_cmd` against the nominal model, below 6 Hz."""
    from scipy.signal import butter, sosfiltfilt

    t = np.arange(columns["t"][0], columns["t"][-1], 1.0 / RECORDED_HZ)
    even = {k: columns_at(t, columns["t"], columns[k]) for k in ("q", "tau", "tau_motor", "tau_cmd")}
    low = butter(4, BAND_HZ, fs=RECORDED_HZ, output="sos")
    q = sosfiltfilt(butter(4, 15.0, fs=RECORDED_HZ, output="sos"), even["q"], axis=0)
    v = np.gradient(q, 1.0 / RECORDED_HZ, axis=0)
    a = np.gradient(v, 1.0 / RECORDED_HZ, axis=0)
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


def largest_fall(before: Gap, after: Gap) -> dict[str, Any]:
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


@dataclass(frozen=True)
class MadeCase:
    """A case as it is written: the model, recordings, and what its label has beside the drawing."""

    sim: str
    train: Columns
    heldout: Columns
    label: dict[str, Any]
    clear: bool
    """Whether its effects show in the held-out data, and its arm stayed under control."""


def make_case(recipe: CaseRecipe, out: Path, labels: Path, train_s: float, heldout_s: float) -> None:
    """Draw, simulate and write a case: `out/case_XXXX/{sim.xml,train.csv,heldout.csv}`, `labels/case_XXXX.json`.

    It is drawn again if it is not clear, and left out if no arm shows its effects.
    """
    make, first = _servo_case if recipe.servos else _torque_case, 0
    for last in (*[False] * (ROUNDS - 1), True):
        drawing = draw(recipe, train_s, heldout_s, first)
        if drawing is None:
            return
        first, made = drawing.attempt + 1, make(drawing, last)
        if made is not None and (made.clear or last):
            folder = out / recipe.name
            folder.mkdir(parents=True, exist_ok=True)
            labels.mkdir(parents=True, exist_ok=True)
            (folder / "sim.xml").write_text(made.sim, encoding="utf-8")
            write_csv(folder / "train.csv", made.train)
            write_csv(folder / "heldout.csv", made.heldout)
            label = {**label_of(drawing), **made.label, "clear": made.clear}
            (labels / f"{recipe.name}.json").write_text(json.dumps(label, indent=1), encoding="utf-8")
            return


def label_of(drawing: CaseDrawing) -> dict[str, Any]:
    """The true effects of the case, for the score."""
    chirp, nominal = "chirp" in drawing.motions["train"], drawing.nominal
    effects = [
        {
            "effect": d.effect,
            "joints": list(d.joints),
            "parameters": d.parameters,
            "axis": nominal.axis[nominal.names.index(d.joints[0])].tolist() if d.joints else None,
            "implied": list(d.implied),
            "undecided": "" if chirp and d.effect in ("actuator.lag", "actuator.delay") else d.undecided,
            "confused_with": list(d.confused_with),
        }
        for d in drawing.drawn
    ]
    return {
        "schema": "armlink.blind-label/1",
        "case": drawing.recipe.name,
        "kind": drawing.recipe.kind,
        "n": nominal.n,
        "effects": effects,
        "motions": {name: list(kinds) for name, kinds in drawing.motions.items()},
    }


def _torque_case(drawing: CaseDrawing, last: bool) -> MadeCase | None:
    """The held-out motion with all effects against that without each in turn (of several: with each alone), and without
    any; None before the training motion if they do not show, unless it is the last attempt."""
    scene, drawn, random, several = drawing.scene, drawing.drawn, drawing.random, bool(drawing.recipe.several)
    seed = int(random.integers(2**31))

    def truth(effects: Sequence[DrawnEffect]) -> TrueArm:
        return true_arm(scene.arm, scene.rated, np.random.default_rng(seed), effects)

    def run(effects: Sequence[DrawnEffect], number: int) -> PlantRun:
        command = (scene.command, drawing.heldout)[number]
        bandwidth = controller_bandwidth(truth(drawn))  # the same controller for all runs
        return PlantRun(truth(effects), command, scene.feed_forward(command), scene.inertia, bandwidth, seed + number)

    shares = {"dq": 0.5, "q_cmd": 0.8, "tau_cmd": 0.8}
    missing = {name for name, share in shares.items() if random.random() >= share}
    if any(effect.startswith("actuator") for effect in drawing.recipe.effects):
        missing.discard("tau_cmd")

    def recorded(run: PlantRun, log: Log, number: int) -> Columns:
        noise = np.random.default_rng([*drawing.recipe.seed, drawing.attempt, 1000 + number])
        return record(run, log, RECORDED_HZ, noise)

    some = [(each,) if several else tuple(d for d in drawn if d is not each) for each in drawn]
    runs = [run(effects, 1) for effects in (drawn, *(some if several or len(drawn) > 1 else ()), ())]
    logs = [simulate(each) for each in runs]
    columns = [recorded(each, log, 1) for each, log in zip(runs, logs, strict=True)]
    gaps = [gap(scene.arm, each) for each in columns]
    # channels that are not recorded do not make a case clear
    seen = [{name: values for name, values in each.items() if name not in missing} for each in gaps]
    others = seen[1 : 1 + len(drawn)]
    falls = [largest_fall(each, seen[-1]) if several else largest_fall(seen[0], each) for each in others]
    clear = all(_is_steady(*each) for each in zip(runs, logs, strict=True))
    clear = clear and (several or all(is_visible(fall) for fall in falls))
    if not (clear or last):
        return None
    training = run(drawn, 0)
    log = simulate(training)
    train, heldout = (
        {name: values for name, values in each.items() if name not in missing}
        for each in (recorded(training, log, 0), columns[0])
    )
    label = {"gap": {"with": gaps[0], "without": gaps[-1], "falls": falls}}
    return MadeCase(mjcf(scene.arm), train, heldout, label, clear and _is_steady(training, log))


def _is_steady(run: PlantRun, log: Log) -> bool:
    """Whether the controller followed its trajectory without oscillation."""
    oscillating = np.abs(np.diff(log.motor, 2, axis=0)).mean(0) > 0.25 * log.motor.std(0) + 0.1
    return bool(np.abs(log.position - run.command).max() < FOLLOWED and not oscillating.any())


def _servo_case(drawing: CaseDrawing, last: bool) -> MadeCase | None:
    """The held-out motion with the effect and without, each against that of the nominal model; None before the training
    motion if they do not differ, unless it is the last attempt."""
    scene, drawn, random, names = drawing.scene, drawing.drawn, drawing.random, drawing.nominal.names
    assert scene.law is not None
    nominal, law, limit = scene.arm, scene.law, 2.0 * scene.rated
    seed, hz, bits = int(random.integers(2**31)), float(random.choice(SERVO_HZ)), int(random.integers(12, 16))
    hold = round(RATE / hz)  # the command is sent with each row, and holds until the next
    paths = [path[np.arange(len(path)) // hold * hold] for path in (scene.command, drawing.heldout)]
    small = np.random.default_rng([seed, 5]).uniform(0.99, 1.01, (2, nominal.n))

    def run(number: int, effects: Sequence[DrawnEffect], perfect: bool = False) -> ServoRun:
        truth = replace(true_arm(nominal, scene.rated, np.random.default_rng(seed), effects), encoder_bits=bits)
        off = np.ones_like(small) if perfect else small
        own = deepcopy(law)
        own.stiffness *= off[0]
        own.damping *= off[1]
        for effect in effects:
            effect.law(own)
        if perfect:
            truth = replace(truth, arm=nominal, state=imperfections(names, ()))
            truth.state.coulomb, truth.state.viscous = nominal.frictionloss, nominal.damping
        truth.state.actuator_saturation = np.minimum(truth.state.actuator_saturation, limit)
        return ServoRun(truth, paths[number], own, seed + number)

    runs = [run(1, drawn), run(1, ()), run(1, (), perfect=True)]
    positions = [simulate_servos(each) for each in runs]
    real, without, ideal = (each[round(SETTLING_S * RATE) :] for each in positions)
    gaps: list[Gap] = [{"q": np.sqrt(np.mean((each - ideal) ** 2, axis=0)).tolist()} for each in (real, without)]
    falls = [largest_fall(*gaps)] * len(drawn)
    clear = all(np.abs(q - paths[1]).max() < SERVO_FOLLOWED for q in positions)
    clear = clear and all(is_visible(fall, VISIBLE_COUNTS * runs[0].truth.encoder_step) for fall in falls)
    if not (clear or last):
        return None
    training = run(0, drawn)
    trained = simulate_servos(training)
    train, heldout = (
        record_servos(each, q, hz, np.random.default_rng([*drawing.recipe.seed, 2000 + number]))
        for number, (each, q) in enumerate(((training, trained), (runs[0], positions[0])))
    )
    known = bool(drawing.recipe.controller_known)
    rows = [
        f'<position name="{name}" joint="{name}" kp="{kp:.9g}" kv="{kv:.9g}" forcerange="{-top:.9g} {top:.9g}"/>'
        for name, kp, kv, top in zip(names, law.stiffness, law.damping, limit, strict=True)
    ]
    label: dict[str, Any] = {"controller_known": known, "gap": {"with": gaps[0], "without": gaps[1], "falls": falls}}
    if drawn:
        whole = label_of(drawing)["effects"][0]
        label["effects"] = [{**whole, "parameters": _whole_parameters(drawn[0], training, names, known)}]
    return MadeCase(
        mjcf(nominal, ["<actuator>", *rows, "</actuator>"] if known else ()),
        train,
        heldout,
        label,
        clear and bool(np.abs(trained - paths[0]).max() < SERVO_FOLLOWED),
    )


def _whole_parameters(effect: DrawnEffect, run: ServoRun, names: Sequence[str], known: bool) -> dict[str, Values]:
    """Parameters as they are answered: all of a joint's friction and inertia, with what the model has of it."""
    arm, state = run.truth.arm, run.truth.state
    whole = {
        "friction.coulomb": ("torque", state.coulomb),
        "friction.viscous": ("damping", state.viscous + (run.law.damping if known else 0.0)),
        "actuator.rotor_inertia": ("inertia", arm.armature + state.rotor_inertia),
    }
    if effect.effect not in whole:
        return effect.parameters
    name, values = whole[effect.effect]
    return {joint: {name: float(values[names.index(joint)])} for joint in effect.parameters}


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as in docs/formats.md: `t`, then `name_1` … `name_n` of each channel."""
    flat: dict[str, Array] = {}
    for name, values in columns.items():
        rounded = np.round(values, DECIMALS.get(name, 5)) + 0.0
        flat |= {name: rounded} if values.ndim == 1 else {f"{name}_{j + 1}": x for j, x in enumerate(rounded.T)}
    with path.open("wb") as file:
        write_numbers(file, flat)


def make_cases(
    out: str, seed: int, cases: int, workers: int, lengths: Sequence[float], effects: str = "", positions: bool = False
) -> None:
    """Make all cases of a check in folders below `out`, in parallel."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    low, _, high = effects.partition("-")
    wanted = recipes(seed, cases, (int(low), int(high)) if high else None)
    labels, train_s, heldout_s = Path(out) / "labels", *lengths
    labels.mkdir(parents=True, exist_ok=True)
    make = partial(make_case, out=Path(out) / "cases", labels=labels, train_s=train_s, heldout_s=heldout_s)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(make, servo_recipes(seed, cases) if positions else wanted))
    withheld = draw_withheld(labels, 1)[::3] if positions else draw_withheld(labels)
    (labels / "withhold.txt").write_text("\n".join(withheld), encoding="utf-8")


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
    make_cases(**json.loads(sys.argv[1]))
