"""Makes cases of servo arms in a process of its own: `python -m sim_gap.blind.servo_cases --out DIR --labels DIR`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, draw_arm, mjcf
from sim_gap.blind.cases import ROUNDS, draw_withheld, is_visible, largest_fall, make_all, parse_words, write_csv
from sim_gap.blind.effects.drawn_effect import Values
from sim_gap.blind.motion import KINDS, RATE, MotionLimits, trajectory
from sim_gap.blind.plant.controller import ServoLaw, ServoRun, Servos
from sim_gap.blind.plant.plant import simulate
from sim_gap.blind.plant.sensors import JITTER_S, columns_at
from sim_gap.blind.recipe import NONE_SHARE
from sim_gap.blind.scene import Scene
from sim_gap.blind.servo_effects import OF_THE_ARM, OF_THE_SERVO, UNKNOWN, ServoChange, draw_effect
from sim_gap.blind.true_arm import Log, sound_arm

ATTEMPTS = 200
UNKNOWN_SHARE = 0.3
"""Share of cases whose model has no controller."""
VISIBLE_COUNTS = 2.0
"""Least increase of a joint's gap by an effect that shows, in counts of the encoder."""
SETTLING_S = 1.0
"""Time at the start of a run that is not judged [s]."""
FOLLOWED = 0.6
"""Largest deviation from the command of an arm under control [rad]."""


@dataclass(frozen=True)
class ServoRecipe:
    name: str
    effect: str
    """Empty for none."""
    known: bool
    """Whether the model has position actuators."""
    seed: tuple[int, int]


@dataclass(frozen=True)
class ServoDrawing:
    """One case drawn: the nominal arm and servo, the effect, and the runs."""

    recipe: ServoRecipe
    nominal: BenchArm
    law: ServoLaw
    limit: Array
    change: ServoChange | None
    hz: float
    runs: tuple[ServoRun, ...]
    """Training; held-out motion of the arm, without the effect, and of the nominal model."""
    motions: dict[str, tuple[str, ...]]


def recipes(seed: int, count: int) -> list[ServoRecipe]:
    """`count` cases, every effect in turn."""
    random = np.random.default_rng([seed, 7])
    known = random.random(count) > UNKNOWN_SHARE
    none = random.permutation(count) < round(NONE_SHARE * count)
    orders = {True: random.permutation([*OF_THE_SERVO, *OF_THE_ARM]), False: random.permutation(UNKNOWN)}
    next_of, out = {True: 0, False: 0}, []
    for k in range(count):
        kind, effect = bool(known[k]), ""
        if not none[k]:
            order = orders[kind]
            effect = str(order[next_of[kind] % len(order)])
            next_of[kind] += 1
        out.append(ServoRecipe(f"case_{k:04d}", effect, kind, (seed, k + 1)))
    return out


def draw(recipe: ServoRecipe, lengths: tuple[float, float], first: int) -> ServoDrawing | None:
    """Draw one case; arms that cannot show its effect are drawn again."""
    for attempt in range(first, first + ATTEMPTS):
        random = np.random.default_rng([*recipe.seed, attempt, 3])
        arm = draw_arm(random, int(random.integers(2, 4)))
        n = arm.n
        velocity = np.linspace(random.uniform(1.0, 1.8), random.uniform(2.0, 3.0), n)
        limits = MotionLimits(arm.lower, arm.upper, velocity, 4.0 * velocity)
        held = str(random.choice(KINDS))
        training = (*(kind for kind in KINDS if kind != held), *(("chirp",) * bool(random.random() < 0.5)))
        scene = Scene(arm, trajectory(training, lengths[0], limits, random))
        omega = 2 * np.pi * random.uniform(2.5, 5.0, n)
        law = _law(scene.inertia * omega**2, 2.0 * random.uniform(0.7, 1.1) * scene.inertia * omega)
        change = draw_effect(recipe.effect, scene, law, random) if recipe.effect else None
        if recipe.effect and change is None:
            continue
        other = trajectory((held,), lengths[1], limits, random)
        return _assemble(recipe, scene, law, change, other, random, {"train": training, "heldout": (held,)})
    return None


def _law(stiffness: Array, damping: Array) -> ServoLaw:
    zero = np.zeros_like(stiffness)
    never = np.full_like(stiffness, np.inf)
    return ServoLaw(stiffness.copy(), damping.copy(), zero.copy(), zero.copy(), never, zero.copy())


def _assemble(
    recipe: ServoRecipe,
    scene: Scene,
    law: ServoLaw,
    change: ServoChange | None,
    other: Array,
    random: np.random.Generator,
    motions: dict[str, tuple[str, ...]],
) -> ServoDrawing:
    nominal = scene.arm
    if change is not None and change.drawn is not None and change.drawn.nominal is not None:
        nominal = change.drawn.nominal(nominal)
    seed, hz = int(random.integers(2**31)), float(random.choice([50.0, 100.0]))
    paths = [_held(path, hz) for path in (scene.command, other)]
    limit, bits = 2.0 * scene.rated, int(random.integers(12, 16))
    small = np.random.default_rng([seed, 5]).uniform(0.99, 1.01, (2, nominal.n))

    def run(number: int, *, wrong: bool, perfect: bool = False) -> ServoRun:
        truth = sound_arm(nominal, scene.rated, np.random.default_rng(seed))
        own = _law(law.stiffness * small[0], law.damping * small[1])
        if perfect:
            own, truth.arm = _law(law.stiffness, law.damping), nominal
            truth.coulomb, truth.viscous = nominal.frictionloss.copy(), nominal.damping.copy()
            truth.ripple[:, 0], truth.position_offset[:], truth.motor_gain[:] = 0.0, 0.0, 1.0
        truth.motor_limit, truth.encoder_bits = limit.copy(), bits
        if wrong and change is not None:
            change.arm(truth)
            change.law(own)
            truth.motor_limit = np.minimum(truth.motor_limit, limit)
        return ServoRun(truth, paths[number], np.zeros_like(paths[number]), scene.inertia, seed + number, own)

    runs = run(0, wrong=True), run(1, wrong=True), run(1, wrong=False), run(1, wrong=False, perfect=True)
    return ServoDrawing(recipe, nominal, law, limit, change, hz, runs, motions)


def _held(path: Array, hz: float) -> Array:
    """The command as it is sent: held from row to row."""
    step = round(RATE / hz)
    return np.asarray(path[np.arange(len(path)) // step * step])


def servo_mjcf(drawing: ServoDrawing) -> str:
    """The nominal arm, with its position actuators if they are known."""
    text = mjcf(drawing.nominal)
    if not drawing.recipe.known:
        return text
    rows = [
        f'<position name="{name}" joint="{name}" kp="{kp:.9g}" kv="{kv:.9g}" forcerange="{-top:.9g} {top:.9g}"/>'
        for name, kp, kv, top in zip(
            drawing.nominal.names, drawing.law.stiffness, drawing.law.damping, drawing.limit, strict=True
        )
    ]
    return text.replace("</mujoco>", "\n".join(["<actuator>", *rows, "</actuator>", "</mujoco>"]))


def recorded(run: ServoRun, log: Log, hz: float, random: np.random.Generator) -> dict[str, Array]:
    """Columns t, q, q_cmd; positions are read at uneven times, each with the command that was sent in its turn."""
    clock = np.arange(len(log.position)) / RATE
    t = np.arange(0.0, clock[-1] - 2.0 / hz, 1.0 / hz)
    sent = run.command[np.rint(t * RATE).astype(int)]
    t[1:] += np.clip(JITTER_S * random.standard_normal(len(t) - 1), -0.2 / hz, 0.2 / hz)
    step = run.truth.encoder_step
    q = columns_at(t, clock, log.position)
    q = np.rint(q / step + 0.2 * random.standard_normal(q.shape)) * step
    return {"t": t, "q": q, "q_cmd": sent}


def judge_drawing(drawing: ServoDrawing, logs: Sequence[Log]) -> tuple[dict[str, Any], bool]:
    """Gap against the nominal model with and without the effect [rad], and whether the case is good."""
    rows = slice(round(SETTLING_S * RATE), None)
    real, without, ideal = (log.position[rows] for log in logs)
    gaps = [{"q": np.sqrt(np.mean((each - ideal) ** 2, axis=0)).tolist()} for each in (real, without)]
    steady = all(_steady(run, log) for run, log in zip(drawing.runs[1:], logs, strict=True))
    falls = [largest_fall(*gaps)] if drawing.change is not None else []
    least = VISIBLE_COUNTS * drawing.runs[0].truth.encoder_step
    seen = all(is_visible(fall, least) for fall in falls)
    return {"with": gaps[0], "without": gaps[1], "falls": falls}, steady and seen


def _steady(run: ServoRun, log: Log) -> bool:
    """Whether the servos followed their command; one that oscillates does not."""
    return bool(np.abs(log.position - run.command).max() < FOLLOWED)


def make_cases(wanted: Sequence[ServoRecipe], out: Path, labels: Path, train_s: float, heldout_s: float) -> None:
    """Draw, simulate and write cases; one that does not show its effect is drawn again, and left out in the end."""
    labels.mkdir(parents=True, exist_ok=True)
    todo = dict.fromkeys(wanted, 0)
    for number in range(ROUNDS):
        drawings = [
            found for recipe, first in todo.items() if (found := draw(recipe, (train_s, heldout_s), first)) is not None
        ]
        if not drawings:
            return
        logs = iter(simulate([run for d in drawings for run in d.runs[1:]], Servos))
        seen = [(d, held, *judge_drawing(d, held)) for d in drawings for held in [[next(logs) for _ in range(3)]]]
        last = number == ROUNDS - 1
        good = [each for each in seen if each[3] or last]
        trained = simulate([d.runs[0] for d, *_ in good], Servos) if good else []
        for (d, held, gaps, fine), train in zip(good, trained, strict=True):
            fine = fine and _steady(d.runs[0], train)
            if fine or last:
                _write(d, train, held[0], {"gap": gaps, "clear": fine}, out / d.recipe.name, labels)
                todo.pop(d.recipe)
        todo = {recipe: first + ATTEMPTS for recipe, first in todo.items()}
        if not todo:
            return


def _write(drawing: ServoDrawing, train: Log, held: Log, more: dict[str, Any], folder: Path, labels: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sim.xml").write_text(servo_mjcf(drawing), encoding="utf-8")
    for number, (name, log) in enumerate((("train", train), ("heldout", held))):
        random = np.random.default_rng([*drawing.recipe.seed, 2000 + number])
        write_csv(folder / f"{name}.csv", recorded(drawing.runs[number], log, drawing.hz, random))
    recipe, change = drawing.recipe, drawing.change
    effects = [] if change is None else [_truth(change, drawing)]
    truth = {
        "schema": "armlink.blind-label/1",
        "case": recipe.name,
        "kind": "single" if effects else "none",
        "n": drawing.nominal.n,
        "effects": effects,
        "motions": {name: list(kinds) for name, kinds in drawing.motions.items()},
    }
    (labels / f"{recipe.name}.json").write_text(
        json.dumps({**truth, "controller_known": recipe.known, **more}, indent=1), encoding="utf-8"
    )


def _truth(change: ServoChange, drawing: ServoDrawing) -> dict[str, Any]:
    joints = [name for name in change.parameters if name != "arm"]
    return {
        "effect": change.effect,
        "joints": joints,
        "parameters": {**change.parameters, **{name: _whole(change, drawing, name) for name in joints}},
        "axis": None,
        "implied": list(change.implied),
        "undecided": change.undecided,
        "confused_with": list(change.confused_with),
    }


def _whole(change: ServoChange, drawing: ServoDrawing, joint: str) -> Values:
    """Parameters of one joint as they are answered: all of its friction and inertia, with what the model has of it."""
    run, j = drawing.runs[0], drawing.nominal.names.index(joint)
    damping = run.truth.viscous + (run.law.damping if drawing.recipe.known else 0.0)
    whole = {
        "friction.coulomb": ("torque", run.truth.coulomb),
        "friction.viscous": ("damping", damping),
        "actuator.rotor_inertia": ("inertia", run.truth.arm.armature),
    }
    if change.effect not in whole:
        return change.parameters[joint]
    name, values = whole[change.effect]
    return {**change.parameters[joint], name: float(values[j])}


def main() -> None:
    given = parse_words(str(__doc__))
    make_all(make_cases, recipes(given.seed, given.cases), given)
    (given.labels / "withhold.txt").write_text("\n".join(draw_withheld(given.labels, 1)[::3]), encoding="utf-8")


if __name__ == "__main__":
    main()
