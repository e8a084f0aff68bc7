"""Arms as others simulate them: published URDF files in MuJoCo, one effect or none, blind.

    python tests/campaigns/simulated_elsewhere.py [--cases N] [--seed S] [--rate HZ] [--torques] [--models FOLDER]

The files come from PyPI (example-robot-data) into FOLDER, by default a temporary one. Servos with the gains below
follow reaches and sums of sines; positions and commands are recorded, or with `--torques` positions, velocities and the
motors' torques. Of positions alone joints from the base on, rate and noise are drawn, and every second model has
something that a simulation of single joints lacks (SURROUNDINGS). Friction that MuJoCo adds creeps: `friction.creep`,
or from torques less friction at low speed, is no other effect.

An effect is tellable if torques were recorded, or if it moves some joint by more than two margins, RMS of all
recordings without noise. Exit status 1 if fewer than 90 % of the tellable effects are first or named as confounded with
the first, a cause that is none has more than 0.8, a tellable effect is told to be no gap, an arm like its model to have
one, or 90 % bands hold less than 85 or more than 95 % of the held-out motion.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis

STEP_S, SECONDS = 0.002, 30
NOISE_RAD_S, NOISE_NM = 1e-3, 0.02
NOISE_RAD = 1e-4, 4.4e-4, 1.5e-3
"""Noise of positions [rad]: of an industrial arm's encoder, of 4,096 counts a turn rounded, and of three counts."""
RATES_HZ = 30.0, 50.0, 100.0
JOINT_COUNTS = 2, 3, 4
RIGHT, CONFIDENT, HELD = 0.9, 0.8, (0.85, 0.95)
TELLABLE = 2.0
"""Motion by an effect from which it has to be told, in margins."""
ALIKE = {"friction.coulomb": ("friction.creep", "friction.stribeck"), "link.payload": ("link.mass_moment",)}
"""What may be told beside an effect."""


@dataclass(frozen=True)
class Arm:
    """A URDF file of the package, and servos for it."""

    file: str
    gains: tuple[float, ...]
    dampings: tuple[float, ...]
    rotors: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


ARMS = {
    "z1": Arm(
        "z1.urdf",
        (120.0, 150.0, 120.0, 40.0, 40.0, 20.0),
        (4.0, 5.0, 4.0, 1.0, 1.0, 0.5),
        (0.03, 0.06, 0.03, 0.02, 0.02, 0.01),
        (-1.5, 0.4, -2.2, -1.0, -1.0, -1.5),
        (1.5, 2.2, -0.6, 1.0, 1.0, 1.5),
    ),
    "ur5": Arm(
        "ur5_robot.urdf",
        (2000.0, 2000.0, 1000.0, 300.0, 300.0, 300.0),
        (200.0, 200.0, 100.0, 20.0, 20.0, 20.0),
        (0.5, 0.5, 0.3, 0.1, 0.1, 0.1),
        (-1.5, -2.2, -1.5, -2.0, -1.5, -2.0),
        (1.5, -0.8, 1.5, 0.0, 1.5, 2.0),
    ),
    "panda": Arm(
        "panda.urdf",
        (900.0, 900.0, 700.0, 700.0, 300.0, 300.0, 100.0),
        (60.0, 60.0, 50.0, 50.0, 20.0, 20.0, 8.0),
        (0.2, 0.2, 0.15, 0.15, 0.08, 0.08, 0.05),
        (-1.0, -1.0, -1.0, -2.3, -1.0, 0.8, -1.0),
        (1.0, 1.0, 1.0, -1.0, 1.0, 2.5, 1.0),
    ),
}


def nominal(arm: Arm, models: Path) -> Any:
    """The file without shapes and what is beyond the arm's joints, with servos and rotors."""
    text = next(models.glob(f"**/{arm.file}")).read_text()
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", text, flags=re.DOTALL)
    compiler = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
    spec = mujoco.MjSpec.from_string(re.sub(r"(<robot[^>]*>)", r"\1" + compiler, text, count=1))
    for thing in (*spec.equalities, *list(spec.joints)[len(arm.gains) :]):
        spec.delete(thing)
    for joint, gain, damping, rotor in zip(spec.joints, arm.gains, arm.dampings, arm.rotors, strict=True):
        servo = spec.add_actuator(name=f"servo_{joint.name}", target=joint.name)
        servo.trntype, servo.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
        servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = gain, -gain, -damping
        joint.armature = rotor
    spec.option.timestep = STEP_S
    spec.compile()
    return spec


def shortened(arm: Arm, joints: int) -> Arm:
    """The first joints of an arm."""
    first = {name: x[:joints] for name, x in vars(arm).items() if isinstance(x, tuple)}
    return replace(arm, **first)


Change = Callable[[Any, int, np.random.Generator], None]
"""Puts an effect into a spec at a joint."""


def coulomb(spec: Any, j: int, random: np.random.Generator) -> None:
    spec.joints[j].frictionloss += spec.actuators[j].gainprm[0] * random.uniform(0.006, 0.02)


def viscous(spec: Any, j: int, random: np.random.Generator) -> None:
    spec.joints[j].damping[0] -= spec.actuators[j].biasprm[2] * random.uniform(0.3, 0.8)


def rotor(spec: Any, j: int, random: np.random.Generator) -> None:
    spec.joints[j].armature *= random.uniform(2.0, 4.0)


def spring(spec: Any, j: int, random: np.random.Generator) -> None:
    spec.joints[j].stiffness[0] = spec.actuators[j].gainprm[0] * random.uniform(0.03, 0.1)
    spec.joints[j].springref = 0.0


def gain(spec: Any, j: int, random: np.random.Generator) -> None:
    factor = random.choice([0.6, 0.75, 1.4])
    spec.actuators[j].gainprm[0] *= factor
    spec.actuators[j].biasprm[1] *= factor


def delay(spec: Any, j: int, random: np.random.Generator) -> None:
    late = random.uniform(0.015, 0.04)
    spec.actuators[j].delay, spec.actuators[j].nsample = late, int(late / spec.option.timestep) + 3


def payload(spec: Any, j: int, random: np.random.Generator) -> None:
    body = list(spec.joints)[-1].parent.add_body(pos=[0.03, 0.01, 0.05])
    body.mass, body.inertia, body.explicitinertial = random.uniform(0.3, 1.5), [1e-3] * 3, True


def tilt(spec: Any, j: int, random: np.random.Generator) -> None:
    angle = random.uniform(0.04, 0.1)
    spec.option.gravity = [9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle)]


BODIES: dict[str, Change] = {"link.payload": payload, "base.tilt": tilt}
JOINTS: dict[str, Change] = {
    "friction.coulomb": coulomb,
    "friction.viscous": viscous,
    "actuator.rotor_inertia": rotor,
    "transmission.spring": spring,
}
SERVOS: dict[str, Change] = {"controller.stiffness": gain, "controller.delay": delay}


def filters(spec: Any, arm: Arm, random: np.random.Generator) -> None:
    time = random.uniform(0.01, 0.05)
    for servo in spec.actuators:
        servo.dyntype, servo.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, time


def compensation(spec: Any, arm: Arm, random: np.random.Generator) -> None:
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0


def contact(spec: Any, arm: Arm, random: np.random.Generator) -> None:
    """A stop on the first link where the tip comes at some posture."""
    model = spec.compile()
    data, joints = mujoco.MjData(model), list(spec.joints)
    data.qpos[:] = random.uniform(arm.low, arm.high)
    mujoco.mj_kinematics(model, data)
    first, last = joints[0].parent, joints[-1].parent
    tip = data.body(last.name)
    tip_at = tip.xpos + tip.xmat.reshape(3, 3) @ [0.0, 0.0, REACH_M]
    at = data.body(first.name)
    last.add_geom(size=[STOP_M] * 3, pos=[0.0, 0.0, REACH_M], mass=0.0)
    first.add_geom(size=[STOP_M] * 3, pos=at.xmat.reshape(3, 3).T @ (tip_at - at.xpos), mass=0.0)


def integrator(spec: Any, arm: Arm, random: np.random.Generator) -> None:
    kinds = mujoco.mjtIntegrator
    spec.option.integrator = random.choice(
        [int(kinds.mjINT_RK4), int(kinds.mjINT_IMPLICIT), int(kinds.mjINT_IMPLICITFAST)]
    )
    spec.option.timestep = random.choice([0.001, 0.002, 0.004])


def free_base(spec: Any, arm: Arm, random: np.random.Generator) -> None:
    """Of the model alone: the arm itself stands."""
    spec.bodies[1].add_freejoint()


STOP_M, REACH_M = 0.03, 0.15
"""Radius of a stop, and distance of the tip's from its joint [m]."""
SURROUNDINGS: dict[str, Callable[[Any, Arm, np.random.Generator], None]] = {
    "filter": filters,
    "gravcomp": compensation,
    "contact": contact,
    "integrator": integrator,
    "free base": free_base,
}
"""What a model has beside joints and servos, and the arm too but for the free base."""


def commands(arm: Arm, steps: int, random: np.random.Generator, reaching: bool) -> np.ndarray:
    """Reaches with rests, or sums of three sines, one a step (steps, n) [rad]."""
    low, high = np.array(arm.low), np.array(arm.high)
    t = np.arange(steps) * STEP_S
    if not reaching:
        hertz, phase = random.uniform(0.05, 0.6, (3, len(low))), random.uniform(0.0, 6.0, (3, len(low)))
        size = 0.15 * (high - low) * np.minimum(1.0, 0.25 / hertz)
        waves = size * np.sin(2.0 * np.pi * hertz * t[:, None, None] + phase)
        return np.asarray(0.5 * (low + high) + waves.sum(1))
    parts, at, length = [], random.uniform(low, high), 0
    while length < steps:
        goal, share = random.uniform(low, high), np.linspace(0.0, 1.0, int(random.uniform(0.8, 2.5) / STEP_S))
        way = (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)[:, None]
        parts += [at + (goal - at) * way, np.tile(goal, (int(random.uniform(0.1, 0.6) / STEP_S), 1))]
        length, at = length + len(parts[-2]) + len(parts[-1]), goal
    return np.concatenate(parts)[:steps]


def recorded(
    spec: Any, arm: Arm, given: np.ndarray, every: float, random: np.random.Generator, noise: float, torques: bool
) -> Recording:
    """Commands held from row to row, `every` [s], and positions; with `torques` smooth commands, velocities and motors'
    torques. `given` are commands at STEP_S."""
    model = spec.compile()
    data, n, dt = mujoco.MjData(model), len(arm.gains), float(model.opt.timestep)
    data.qpos[:], data.ctrl[:] = given[0], given[0]
    if model.na:
        data.act[:] = given[0]
    for i in np.flatnonzero(model.actuator_history[:, 0]).tolist():
        past = np.full((int(model.actuator_history[i, 0]), 1), given[0, i])
        mujoco.mj_initCtrlHistory(model, data, i, None, past)
    rows, stride = [], round(every / dt)
    for k in range(round(len(given) * STEP_S / dt)):
        command = given[min(int(k * dt / STEP_S), len(given) - 1)]
        if torques or k % stride == 0:
            data.ctrl[:] = command
        if k % stride == 0:
            mujoco.mj_forward(model, data)
            rows.append(np.concatenate([data.qpos, command, data.qvel, data.qfrc_actuator]))
        mujoco.mj_step(model, data)
    q, wanted, v, torque = (
        each + size * random.standard_normal((len(rows), n))
        for each, size in zip(np.split(np.array(rows), 4, axis=1), (noise, 0.0, NOISE_RAD_S, NOISE_NM), strict=True)
    )
    t, names = np.arange(len(rows)) * stride * dt, tuple(joint.name for joint in spec.joints)
    if torques:
        return Recording(t=t, position=q, velocity=v, motor_torque=torque, names=names)
    return Recording(t=t, position=q, position_command=wanted, names=names)


@dataclass(frozen=True)
class Case:
    told: str
    """Arm, effect and circumstances in words."""
    effect: str
    answer: Diagnosis
    moved: np.ndarray
    """RMS motion by the effect in all recordings [rad], (J,)."""

    @property
    def tellable(self) -> bool:
        return self.answer.unit != "rad" or bool(np.any(self.moved > TELLABLE * self.answer.margin))


def case(seed: int, models: Path, rate: float | None, torques: bool) -> Case:
    """One arm with one effect, or none, diagnosed."""
    random = np.random.default_rng(seed)
    name = str(random.choice(list(ARMS)))
    effects = ["", *BODIES, *JOINTS, *({} if torques else SERVOS)]
    effect, around = effects[int(random.integers(len(effects)))], ""
    arm, noise, hertz = ARMS[name], NOISE_RAD[0], rate or RATES_HZ[-1]
    if not torques:
        arm, noise = shortened(arm, int(random.choice(JOINT_COUNTS))), float(random.choice(NOISE_RAD))
        hertz = rate or float(random.choice(RATES_HZ))
        around = str(random.choice(list(SURROUNDINGS))) if random.random() < 0.5 else ""
    spec = nominal(arm, models)
    if around and around != "free base":
        SURROUNDINGS[around](spec, arm, random)
    bare, model = spec.copy(), spec.copy()
    options = {}
    if around == "free base":
        free_base(model, arm, random)
        options = {"base": model.bodies[1].name, "tip": list(model.joints)[-1].parent.name}
    if effect:
        (BODIES | JOINTS | SERVOS)[effect](spec, int(random.integers(0, len(arm.gains))), random)
    given = [commands(arm, round(SECONDS / STEP_S), random, reaching) for reaching in (True, False, True, False)]
    made = [recorded(spec, arm, each, 1.0 / hertz, random, noise, torques) for each in given]
    pairs = [
        [recorded(each, arm, g, 1.0 / hertz, random, 0.0, torques).position for each in (spec, bare)] for g in given
    ]
    moved = np.sqrt(np.mean([np.mean((a - b) ** 2, axis=0) for a, b in pairs], axis=0))
    with tempfile.TemporaryDirectory(prefix="elsewhere-") as folder:
        sim = Path(folder) / "sim.xml"
        model.compile()
        sim.write_text(model.to_xml(), encoding="utf-8")
        answer = diagnose(sim, made[:2], made[2:], **options)
    told = (
        f"{name} {len(arm.gains)} joints, {around or 'plain'}, {hertz:g} Hz, {1e3 * noise:g} mrad, {effect or 'none'}"
    )
    return Case(told, effect, answer, moved)


def main() -> int:
    """Diagnose the cases; exit status 1 where a bound is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, help="rows and commands a second; drawn by default, of torques 100")
    parser.add_argument("--torques", action="store_true")
    parser.add_argument("--models", type=Path)
    options = parser.parse_args()
    models = options.models or Path(tempfile.mkdtemp(prefix="elsewhere-models-"))
    if not list(models.glob(f"**/{ARMS['z1'].file}")):
        install = ["install", "--quiet", "--no-deps", "--target", str(models), "example-robot-data"]
        subprocess.run([sys.executable, "-m", "pip", *install], check=True)
    right = list[bool]()
    false, alarms, missed, holds = 0, 0, 0, list[float]()
    for k in range(options.cases):
        begun = time.process_time()
        made = case(options.seed * 1000 + k, models, options.rate, options.torques)
        answer, effect = made.answer, made.effect
        causes = [(c.effect, round(c.confidence, 2), *c.confounded_with) for c in answer.causes]
        same = {effect, *ALIKE.get(effect, ())}
        false += any(confidence > CONFIDENT and cause not in same for cause, confidence, *_ in causes)
        if effect and made.tellable:
            first = {causes[0][0], *causes[0][2:]} if causes else set()
            right.append(bool(first & same))
            missed += answer.verdict == "no_gap"
        alarms += not effect and answer.verdict != "no_gap"
        holds += [] if answer.band is None else answer.band.holds.tolist()
        verdict = f"{answer.verdict} {answer.unexplained:.1%} {causes}"
        margins = float((made.moved / answer.margin).max())
        held = "" if answer.band is None else f", band {np.mean(answer.band.holds):.0%}"
        spent = time.process_time() - begun
        print(f"{k} {made.told}, {margins:.1f} margins: {verdict}{held}, {spent:.0f} s of a core", flush=True)
    share = float(np.mean(holds)) if holds else float(np.mean(HELD))
    print(
        f"right first or confounded {sum(right)} of {len(right)}, false above {CONFIDENT} in {false}, no gap in "
        f"{missed} with one, alarms {alarms}, bands hold {share:.1%}"
    )
    return int(sum(right) < RIGHT * len(right) or false + missed + alarms > 0 or not HELD[0] <= share <= HELD[1])


if __name__ == "__main__":
    sys.exit(main())
