"""Cases of a round, drawn from one seed: what a tool sees goes into `cases`, the rest is sealed."""

import json
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from referee import mujoco_plant, seal
from sim_gap.blind.cases import make_case, write_csv
from sim_gap.blind.effects import EFFECTS, controller
from sim_gap.blind.recipe import CaseRecipe
from sim_gap.blind.score import BESIDE_POINT

TORQUE_S, POSITION_S = (60.0, 20.0), (36.0, 18.0)
"""Seconds of training and held-out recordings of the first plant."""
ATTEMPTS = 40
"""Number of drawings of a case whose effects no arm shows."""
STRATA = (
    "simulated torque sensors, one effect",
    "MuJoCo, motor torque, one effect",
    "simulated servos, positions alone, one effect",
    "MuJoCo, positions alone, one effect",
    "simulated torque sensors, 3 to 8 effects",
    "no effect",
    "MuJoCo, a body or a tilt",
    "outside of every library",
    "the effect withheld",
    "one servo on a pendulum, positions alone",
    "MuJoCo, two effects",
)
"""The kinds of cases, of which every round has nearly equal numbers."""
DRY = {"friction.stribeck", "friction.load", "friction.asymmetric"}
"""Effects beside which a joint's dry friction is not one number."""
VECTORS = {"link.mass_moment", "link.inertia", "base.tilt"}
"""Effects whose parameters depend on a frame, and so are not compared between tools."""
Json = dict[str, Any]


@dataclass(frozen=True)
class Drawn:
    """One case: text of the nominal model, columns of recordings, label."""

    sim: str
    train: Sequence[Json]
    heldout: Json
    joints: tuple[str, ...]
    kind: str
    label: Json


def strata(seed: int, count: int) -> list[str]:
    """The kind of each case, in an order that says nothing."""
    order = [STRATA[k % len(STRATA)] for k in range(count)]
    return [order[k] for k in np.random.default_rng([seed, 11]).permutation(count)]


def draw_case(
    seed: int, number: int, stratum: str, out: Path, key: bytes, cpu_seconds: float, models: Path | None
) -> tuple[str, str]:
    """Draw one case into `out/cases/CASE` and `out/sealed`; its name and the hash of its sealed part."""
    random = np.random.default_rng([seed, 13, number])
    drawn = _draw(stratum, seed, number, random, models)
    name, folder = f"case_{number:03d}", out / "cases" / f"case_{number:03d}"
    folder.mkdir(parents=True)
    (folder / "sim.xml").write_text(drawn.sim, encoding="utf-8")
    for k, columns in enumerate(drawn.train, start=1):
        write_csv(folder / f"train_{k}.csv", columns)
    label = {"case": name, "stratum": stratum, "kind": drawn.kind, "joints": drawn.joints, **drawn.label}
    told = {"joints": drawn.joints, "kind": drawn.kind, "withheld": label["withheld"], "cpu_seconds": cpu_seconds}
    (folder / "case.json").write_text(json.dumps(told), encoding="utf-8")
    held = {channel: np.asarray(values).tolist() for channel, values in drawn.heldout.items()}
    return name, seal.seal(out / "sealed", name, {"label": label, "heldout": held}, key)


def _draw(stratum: str, seed: int, number: int, random: np.random.Generator, models: Path | None) -> Drawn:
    if stratum == STRATA[0]:
        return first_plant(seed, number, [str(random.choice(EFFECTS))])
    if stratum == STRATA[2]:
        every = [*controller.DRAWS, *controller.OF_THE_ARM]
        return first_plant(seed, number, [str(random.choice(every))], positions=True)
    if stratum == STRATA[4]:
        return first_plant(seed, number, [], several=int(random.integers(3, 9)))
    if stratum == STRATA[5] and random.random() < 0.5:
        return first_plant(seed, number, [], positions=random.random() < 0.5)
    if stratum == STRATA[8]:
        return first_plant(seed, number, [str(random.choice(EFFECTS))], withheld=True)
    return second_plant(stratum, random, models)


def first_plant(
    seed: int,
    number: int,
    effects: Sequence[str],
    positions: bool = False,
    several: int = 0,
    withheld: bool = False,
) -> Drawn:
    """A case of `armlink gap bench`. An effect that no arm shows gives way to another one."""
    random = np.random.default_rng([seed, 17, number])
    every = [*controller.DRAWS, *controller.OF_THE_ARM] if positions else list(EFFECTS)
    for attempt in range(ATTEMPTS):
        known = True if positions else None
        recipe = CaseRecipe("case", tuple(effects), (seed, 1000 * number + attempt), several, known)
        with tempfile.TemporaryDirectory(prefix="referee-") as scratch:
            cases, labels = Path(scratch) / "cases", Path(scratch) / "labels"
            make_case(recipe, cases, labels, *(POSITION_S if positions else TORQUE_S))
            if (labels / "case.json").is_file():
                truth = json.loads((labels / "case.json").read_text(encoding="utf-8"))
                if not (withheld and truth["effects"][0]["undecided"]):
                    return _read_first(cases / "case", truth, positions, withheld)
        if effects:
            effects = [str(random.choice(every))]
    raise RuntimeError(f"case {number}: no arm shows its effects")


def _read_first(folder: Path, truth: Json, positions: bool, withheld: bool) -> Drawn:
    sim = (folder / "sim.xml").read_text(encoding="utf-8")
    joints = tuple(f"joint_{j + 1}" for j in range(truth["n"]))
    columns = [read_columns(folder / f"{name}.csv", truth["n"]) for name in ("train", "heldout")]
    effects = [
        {k: e[k] for k in ("effect", "joints", "implied", "undecided", "confused_with")} for e in truth["effects"]
    ]
    label = {
        "plant": "simulated arm",
        "effects": effects,
        "withheld": [e["effect"] for e in effects] if withheld else [],
        "nearest": [],
        "outside": False,
        "truth": _first_truth(sim, truth, joints, positions),
    }
    return Drawn(sim, columns[:1], columns[1], joints, "positions" if positions else "torque", label)


def _first_truth(sim: str, truth: Json, joints: Sequence[str], positions: bool) -> list[Json]:
    """Every known value: totals of the joints, and the parameters of the drawn effects."""
    spec = mujoco.MjSpec.from_string(sim)
    nominal = _nominal(spec, positions)
    drawn = {(e["effect"], joint) for e in truth["effects"] for joint in e["joints"]}
    rows = []
    for key, values in truth["totals"].items():
        effect, quantity = key.split(":")
        for j, joint in enumerate(joints):
            dry = effect == "friction.coulomb" and any((each, joint) in drawn for each in DRY)
            if not dry and (key in nominal or (effect, joint) in drawn):
                at = nominal[key][j] if key in nominal else float(quantity == "gain")
                rows.append(_row(effect, quantity, joint, values[j], at, (effect, joint) in drawn))
    for e in truth["effects"]:
        for joint, values in e["parameters"].items():
            for quantity, value in values.items():
                known = f"{e['effect']}:{quantity}" in truth["totals"]
                payload = e["effect"] == "link.payload" and quantity != "mass"
                if not known and not payload and e["effect"] not in VECTORS and quantity not in BESIDE_POINT:
                    name = "" if joint == "arm" else joint
                    rows.append(_row(e["effect"], quantity, name, value, float(quantity == "gain"), True))
    return rows


def _row(effect: str, quantity: str, joint: str, value: float, nominal: float, drawn: bool) -> Json:
    return {
        "effect": effect,
        "quantity": quantity,
        "joint": joint,
        "value": value,
        "nominal": nominal,
        "drawn": drawn,
    }


def _nominal(spec: Any, positions: bool) -> dict[str, list[float]]:
    """Totals of the nominal model."""
    return {k: v for k, v in mujoco_plant.totals(spec, not positions).items() if not k.startswith("transmission")}


def second_plant(stratum: str, random: np.random.Generator, models: Path | None) -> Drawn:
    """A case of MuJoCo's plant."""
    pendulum = stratum == STRATA[9]
    torques = stratum == STRATA[1] or (stratum not in (STRATA[3], STRATA[9]) and random.random() < 0.5)
    drawn = mujoco_plant.draw_nominal(random, pendulum, torques, models)
    spec, nominal = drawn.spec(), drawn.spec()
    joints = tuple(joint.name for joint in spec.joints)
    bodies, outside = stratum == STRATA[6], stratum == STRATA[7]
    shown = list(mujoco_plant.OUTSIDE) if outside else mujoco_plant.effects_shown(torques, bodies)
    count = {STRATA[5]: 0, STRATA[10]: 2}.get(stratum, 1)
    chosen = [str(each) for each in random.choice(shown, count, replace=False)]
    places = {effect: int(random.integers(0, len(joints))) for effect in chosen}
    missing = bodies and chosen == ["link.payload"] and random.random() < 0.3
    for effect, joint in places.items():
        mujoco_plant.apply(nominal if missing else spec, effect, joint, random)
    made = [mujoco_plant.record(drawn, spec, random, reaching, torques) for reaching in (True, False, True)]
    effects = [_second_effect(effect, joints[places[effect]]) for effect in chosen if not outside]
    label = {
        "plant": "MuJoCo",
        "effects": effects,
        "withheld": [],
        "nearest": [each for effect in chosen if outside for each in mujoco_plant.NEAREST[effect]],
        "outside": outside,
        "truth": _second_truth(spec, nominal, effects, joints, torques),
    }
    *train, heldout = [_columns(recording) for recording in made]
    text = re.sub(r'model="[^"]*"', 'model="arm"', nominal.to_xml(), count=1)
    return Drawn(text, train, heldout, joints, "motor_torque" if torques else "positions", label)


def _second_effect(effect: str, joint: str) -> Json:
    whole = effect in mujoco_plant.elsewhere.BODIES
    alike = mujoco_plant.elsewhere.ALIKE.get(effect, ())
    return {
        "effect": effect,
        "joints": [] if whole else [joint],
        "implied": list(alike),
        "undecided": "",
        "confused_with": [],
    }


def _second_truth(spec: Any, nominal: Any, effects: Sequence[Json], joints: Sequence[str], torques: bool) -> list[Json]:
    real, model = (mujoco_plant.totals(each, torques) for each in (spec, nominal))
    drawn = {(e["effect"], joint) for e in effects for joint in e["joints"]}
    rows = []
    for key, values in real.items():
        effect, quantity = key.split(":")
        for j, joint in enumerate(joints):
            rows.append(_row(effect, quantity, joint, values[j], model[key][j], (effect, joint) in drawn))
    if any(e["effect"] == "link.payload" for e in effects):
        mass = float(spec.compile().body_mass.sum() - nominal.compile().body_mass.sum())
        rows.append(_row("link.payload", "mass", "", mass, 0.0, True))
    return rows


def _columns(recording: Any) -> Json:
    named = {
        "q": recording.position,
        "dq": recording.velocity,
        "tau_motor": recording.motor_torque,
        "q_cmd": recording.position_command,
    }
    return {"t": recording.t, **{name: values for name, values in named.items() if values is not None}}


def read_columns(path: Path, n: int) -> Json:
    from referee.interface import read_recording

    recorded = read_recording(path, n)
    return {"t": recorded.t, **recorded.channels}
