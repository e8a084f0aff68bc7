"""Makes the cases of the blind check, and says which of them are diagnosed again without their effect."""

import json
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from armlink.recording.csv_text import write_numbers
from gcomp.arrays import Array
from sim_bus.effects.registry import imperfections
from sim_gap.blind.arms import inverse, mjcf
from sim_gap.blind.effects.drawn_effect import DrawnEffect
from sim_gap.blind.motion import RATE, RECORDED_HZ
from sim_gap.blind.plant import TrueArm, columns_at, controller_bandwidth, record, simulate, true_arm
from sim_gap.blind.recipe import CaseDrawing, CaseRecipe, draw
from sim_gap.blind.scene import LEAST_SPEED, ServoLaw, rms
from sim_gap.blind.servo_plant import record_servos, simulate_servos

VISIBLE_RATIO, VISIBLE_LEAST, VISIBLE_COUNTS = 3.0, 0.08, 2.0
"""Least factor on some held-out gap, and least increase of it by a visible effect: [N·m], and of positions alone counts
of the encoder."""
CHANNEL_SHARES = {"dq": 0.5, "q_cmd": 0.8, "tau_cmd": 0.8}
"""Channel that not every case has → share of those that do; that of tau_cmd is 1 for effects of drives."""
FOLLOWED, SERVO_FOLLOWED = 0.3, 0.6
"""Largest deviation from the command [rad] of an arm under control, and of one with servos."""
DECIMALS = {"t": 6, "q": 7, "dq": 6, "q_cmd": 7}
"""Of a column in a file; 5 of the others."""
JOINT_TOTALS = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia")
"""Effects of which positions show all that a joint has, with what the model has of it."""
Columns = dict[str, Array]
Gap = dict[str, list[float]]
Totals = dict[str, list[float]]
"""True values of each joint, small errors of every arm included, by `EFFECT:QUANTITY`."""


def largest_fall(before: Gap, after: Gap) -> dict[str, Any]:
    """Channel and joint at which the effect's absence lowers the gap most, with both values and the shrink."""
    falls = [
        (b - a, channel, j, b, a)
        for channel in before
        for j, (b, a) in enumerate(zip(before[channel], after[channel], strict=True))
    ]
    _, channel, j, b, a = max(falls)
    return {"channel": channel, "joint": f"joint_{j + 1}", "before": b, "after": a, "shrink": 1.0 - a / max(b, 1e-9)}


class Trial(NamedTuple):
    """One motion of a true arm."""

    columns: Columns
    """Of its recording."""
    position: Array
    """Exact readings at `motion.RATE` (K, n) [rad]."""
    is_steady: bool
    """Whether the arm followed its command without oscillation."""


class Rig:
    """The arm of a drawing, with any effects."""

    missing = frozenset[str]()
    """Channels that are not recorded."""

    def __init__(self, drawing: CaseDrawing) -> None:
        self.drawing, self.scene = drawing, drawing.scene
        self.seed = int(drawing.random.integers(2**31))

    def truth(self, effects: Sequence[DrawnEffect]) -> TrueArm:
        return true_arm(self.scene.arm, self.scene.rated, np.random.default_rng(self.seed), effects)

    def noise(self, number: int) -> np.random.Generator:
        return np.random.default_rng([*self.drawing.recipe.seed, self.drawing.attempt, number])

    def totals(self) -> Totals:
        truth = self.truth(self.drawing.drawn)
        state = truth.state
        values = {
            "friction.coulomb:torque": state.coulomb,
            "friction.viscous:damping": state.viscous,
            "actuator.rotor_inertia:inertia": truth.arm.armature + state.rotor_inertia,
            "actuator.gain:gain": state.actuator_gain,
            "torque.gain:gain": state.torque_gain,
            "torque.offset:offset": state.torque_offset,
            "position.offset:offset": state.position_offset,
        }
        return {name: each.tolist() for name, each in values.items()}


class TorqueRig(Rig):
    """With torque sensors, under a controller with feed-forward."""

    least_fall = VISIBLE_LEAST

    def __init__(self, drawing: CaseDrawing) -> None:
        super().__init__(drawing)
        self.bandwidth = controller_bandwidth(self.truth(drawing.drawn))  # the same controller for all runs
        missing = {name for name, share in CHANNEL_SHARES.items() if drawing.random.random() >= share}
        of_drives = any(effect.startswith("actuator") for effect in drawing.recipe.effects)
        self.missing = frozenset(missing - {"tau_cmd"} if of_drives else missing)
        self.sim = mjcf(self.scene.arm)

    def run(self, number: int, command: Array, effects: Sequence[DrawnEffect]) -> Trial:
        """The command of motion `number` under these effects."""
        truth = self.truth(effects)
        log = simulate(truth, self.scene, command, self.bandwidth, self.seed + number)
        oscillating = np.abs(np.diff(log.motor, 2, axis=0)).mean(0) > 0.25 * log.motor.std(0) + 0.1
        is_steady = bool(np.abs(log.position - command).max() < FOLLOWED and not oscillating.any())
        return Trial(record(truth, command, log, self.noise(1000 + number)), log.position, is_steady)

    def gap(self, trial: Trial) -> Gap:
        """RMS [N·m] per joint of `tau`, `tau_motor` and `tau_cmd` against the nominal model, below 6 Hz."""
        arm, columns = self.scene.arm, trial.columns
        t = np.arange(columns["t"][0], columns["t"][-1], 1.0 / RECORDED_HZ)
        even = {k: columns_at(t, columns["t"], columns[k]) for k in ("q", "tau", "tau_motor", "tau_cmd")}
        low, smooth = (butter(4, hz, fs=RECORDED_HZ, output="sos") for hz in (6.0, 15.0))
        q = sosfiltfilt(smooth, even["q"], axis=0)
        v = np.gradient(q, 1.0 / RECORDED_HZ, axis=0)
        a = np.gradient(v, 1.0 / RECORDED_HZ, axis=0)
        motor = inverse(self.scene.model, q, v, a)
        link = motor - arm.armature * a
        motor = motor + arm.damping * v + arm.frictionloss * np.tanh(v / LEAST_SPEED)
        out = {}
        for channel, nominal in (("tau", link), ("tau_motor", motor), ("tau_cmd", motor)):
            rest = sosfiltfilt(low, even[channel] - nominal, axis=0)[100:-100]
            # at rest friction is undetermined, which no sensor on the link reads
            counts = (np.abs(v[100:-100]) > LEAST_SPEED) | (channel == "tau")
            mean = np.where(counts, rest**2, 0.0).sum(0) / np.maximum(counts.sum(0), 1)
            out[channel] = np.sqrt(mean).tolist()
        return out


class ServoRig(Rig):
    """With position servos, of which the model may know, and no torques."""

    def __init__(self, drawing: CaseDrawing) -> None:
        super().__init__(drawing)
        arm, law = self.scene.arm, self.scene.law
        assert law is not None
        self.law, self.limit, self.hz = law, 2.0 * self.scene.rated, float(drawing.random.choice((50.0, 100.0)))
        self.encoder_step = 2 * np.pi / 2 ** int(drawing.random.integers(12, 16))
        self.least_fall = VISIBLE_COUNTS * self.encoder_step
        self.small = np.random.default_rng([self.seed, 5]).uniform(0.99, 1.01, (2, arm.n))
        rows = [
            f'<position name="{name}" joint="{name}" kp="{kp:.9g}" kv="{kv:.9g}" forcerange="{-top:.9g} {top:.9g}"/>'
            for name, kp, kv, top in zip(arm.names, law.stiffness, law.damping, self.limit, strict=True)
        ]
        self.sim = mjcf(arm, ["<actuator>", *rows, "</actuator>"] if drawing.recipe.controller_known else ())
        state = imperfections(arm.names, ())
        state.coulomb, state.viscous, state.actuator_saturation = arm.frictionloss, arm.damping, self.limit
        self.nominal = simulate_servos(replace(self.truth(()), arm=arm, state=state), self.held(drawing.heldout), law)
        """Held-out positions of the nominal model (K, n) [rad]."""

    def truth(self, effects: Sequence[DrawnEffect]) -> TrueArm:
        truth = super().truth(effects)
        truth.state.actuator_saturation = np.minimum(truth.state.actuator_saturation, self.limit)
        return truth

    def run(self, number: int, command: Array, effects: Sequence[DrawnEffect]) -> Trial:
        """The command of motion `number`, sent with each row and held until the next, under these effects."""
        held = self.held(command)
        position = simulate_servos(self.truth(effects), held, self.true_law(effects))
        columns = record_servos(held, position, self.hz, self.encoder_step, self.noise(2000 + number))
        return Trial(columns, position, bool(np.abs(position - held).max() < SERVO_FOLLOWED))

    def true_law(self, effects: Sequence[DrawnEffect]) -> ServoLaw:
        law = deepcopy(self.law)
        law.stiffness *= self.small[0]
        law.damping *= self.small[1]
        for effect in effects:
            effect.law(law)
        return law

    def totals(self) -> Totals:
        """As without servos; damping is the joint's and the servo's together, since a position cannot tell them."""
        law, values = self.true_law(self.drawing.drawn), super().totals()
        damping = np.add(values["friction.viscous:damping"], law.damping).tolist()
        return values | {"friction.viscous:damping": damping, "controller.stiffness:kp": law.stiffness.tolist()}

    def held(self, command: Array) -> Array:
        rows = round(RATE / self.hz)
        return command[np.arange(len(command)) // rows * rows]

    def gap(self, trial: Trial) -> Gap:
        """RMS [rad] of held-out positions against those of the nominal model, but for the first second."""
        return {"q": rms((trial.position - self.nominal)[round(RATE) :]).tolist()}


def make_case(recipe: CaseRecipe, out: Path, labels: Path, train_s: float, heldout_s: float) -> None:
    """Draw, simulate and write a case: `out/case_XXXX/{sim.xml,train.csv,heldout.csv}`, `labels/case_XXXX.json`.

    It is drawn again if its effects do not show in the held-out data or its arm is not steady, and left out after four
    drawings, or if no arm can show them.
    """
    first = 0
    for _ in range(4):
        drawing = draw(recipe, train_s, heldout_s, first)
        if drawing is None or write_case(drawing, out / recipe.name, labels / f"{recipe.name}.json"):
            return
        first = drawing.attempt + 1


def write_case(drawing: CaseDrawing, folder: Path, label: Path) -> bool:
    """Simulate and write one drawing; whether it was: it is not if some effect does not show by itself."""
    rig: TorqueRig | ServoRig = (ServoRig if drawing.recipe.servos else TorqueRig)(drawing)
    drawn, several = drawing.drawn, drawing.recipe.several
    sets: list[tuple[DrawnEffect, ...]] = [drawn, *([(each,) for each in drawn] if len(drawn) > 1 else ()), ()]
    trials = [rig.run(1, drawing.heldout, effects) for effects in sets]
    gaps = [rig.gap(trial) for trial in trials]
    # channels that are not recorded do not make a case clear
    *alone, sound = [{name: gap for name, gap in each.items() if name not in rig.missing} for each in gaps]
    falls = [largest_fall(each, sound) for each in alone[-len(drawn) :] if drawn]
    pairs = [(fall["before"], fall["after"]) for fall in falls]
    if not (several or all(b > VISIBLE_RATIO * a and b - a > rig.least_fall for b, a in pairs)):
        return False
    training = rig.run(0, drawing.scene.command, drawn)
    if not all(trial.is_steady for trial in (training, *trials)):
        return False
    for path in (folder, label.parent):
        path.mkdir(parents=True, exist_ok=True)
    (folder / "sim.xml").write_text(rig.sim, encoding="utf-8")
    for name, trial in (("train", training), ("heldout", trials[0])):
        recorded = {channel: values for channel, values in trial.columns.items() if channel not in rig.missing}
        write_csv(folder / f"{name}.csv", recorded)
    gap, totals = {"with": gaps[0], "without": gaps[-1], "falls": falls}, rig.totals()
    told = {**label_of(drawing, totals), "gap": gap, "clear": True, "totals": totals}
    label.write_text(json.dumps(told, indent=1), encoding="utf-8")
    return True


def label_of(drawing: CaseDrawing, totals: Totals) -> dict[str, Any]:
    """The true effects of the case, for the score; `totals` of the arm with these effects."""
    chirp, nominal = "chirp" in drawing.motions["train"], drawing.scene.arm
    effects = [
        {
            "effect": d.effect,
            "joints": list(d.joints),
            "parameters": _reported(d, nominal.names, totals) if drawing.recipe.servos else d.parameters,
            "axis": nominal.axis[nominal.names.index(d.joints[0])].tolist() if d.joints else None,
            "implied": list(d.implied),
            "undecided": "" if chirp and d.effect in ("actuator.lag", "actuator.delay") else d.undecided,
            "confused_with": list(d.confused_with),
        }
        for d in drawing.drawn
    ]
    known = {"controller_known": drawing.recipe.controller_known} if drawing.recipe.servos else {}
    return {
        "schema": "armlink.blind-label/1",
        "case": drawing.recipe.name,
        "kind": drawing.recipe.kind,
        "n": nominal.n,
        "effects": effects,
        "motions": {name: list(kinds) for name, kinds in drawing.motions.items()},
        **known,
    }


def _reported(drawn: DrawnEffect, names: Sequence[str], totals: Totals) -> dict[str, dict[str, float]]:
    """Parameters of an effect as positions alone show them: friction and inertia of a joint with what the model has."""
    for key, values in totals.items():
        effect, _, name = key.partition(":")
        if effect == drawn.effect and effect in JOINT_TOTALS:
            return {joint: {name: values[names.index(joint)]} for joint in drawn.joints}
    return drawn.parameters


def write_csv(path: Path, columns: dict[str, Array]) -> None:
    """Write columns as in docs/formats.md: `t`, then `name_1` … `name_n` of each channel."""
    flat: dict[str, Array] = {}
    for name, values in columns.items():
        rounded = np.round(values, DECIMALS.get(name, 5)) + 0.0
        flat |= {name: rounded} if values.ndim == 1 else {f"{name}_{j + 1}": x for j, x in enumerate(rounded.T)}
    with path.open("wb") as file:
        write_numbers(file, flat)


def write_withheld(labels: Path, positions: bool) -> None:
    """List what is to be diagnosed again without the true effect in `withhold.txt`, a line "CASE EFFECT" each.

    The first two single-effect cases of every effect that the recording can separate; of positions alone the first, of
    every third effect.
    """
    chosen: dict[str, list[str]] = {}
    for path in sorted(labels.glob("*.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        if truth["kind"] == "single" and not truth["effects"][0]["undecided"]:
            chosen.setdefault(truth["effects"][0]["effect"], []).append(truth["case"])
    each, turn = (1, 3) if positions else (2, 1)
    lines = [f"{case} {effect}" for effect in sorted(chosen)[::turn] for case in chosen[effect][:each]]
    (labels / "withhold.txt").write_text("\n".join(lines), encoding="utf-8")
