"""Arms as others simulate them: published URDF files in MuJoCo with its defaults, one effect or none, blind.

    python tests/campaigns/simulated_elsewhere.py [--cases N] [--seed S] [--rate HZ] [--torques] [--models FOLDER]

The files come from PyPI (example-robot-data) into FOLDER, by default a temporary one. Servos with the gains below
follow reaches and sums of sines; positions and commands are recorded, or with `--torques` positions, velocities and the
motors' torques. Friction that MuJoCo adds creeps: `friction.creep`, or from torques less friction at low speed, is no
other effect. Exit status 1 if fewer than 85 % of the effects are first, a cause that is none has more than 0.8, or an
arm like its model is told to have a gap.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis

STEP_S, SECONDS = 0.002, 30
NOISE_RAD, NOISE_RAD_S, NOISE_NM = 1e-4, 1e-3, 0.02
RIGHT, CONFIDENT = 0.85, 0.8
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
    """The file without shapes and fingers, with servos and rotors."""
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
    spec.actuators[j].delay, spec.actuators[j].nsample = late, int(late / STEP_S) + 3


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
    spec: Any,
    arm: Arm,
    random: np.random.Generator,
    every: int,
    reaching: bool,
    torques: bool,
    seconds: float = SECONDS,
) -> Recording:
    """Commands held from row to row, `every` so many steps, and positions; with `torques` smooth commands, velocities
    and motors' torques."""
    model = spec.compile()
    data, n = mujoco.MjData(model), len(arm.gains)
    given = commands(arm, round(seconds / STEP_S), random, reaching)
    data.qpos[:], data.ctrl[:] = given[0], given[0]
    for i in np.flatnonzero(model.actuator_history[:, 0]).tolist():
        past = np.full((int(model.actuator_history[i, 0]), 1), given[0, i])
        mujoco.mj_initCtrlHistory(model, data, i, None, past)
    rows = []
    for k, command in enumerate(given):
        if torques or k % every == 0:
            data.ctrl[:] = command
        if k % every == 0:
            mujoco.mj_forward(model, data)
            rows.append(np.concatenate([data.qpos, command, data.qvel, data.qfrc_actuator]))
        mujoco.mj_step(model, data)
    q, wanted, v, torque = (
        each + noise * random.standard_normal((len(rows), n))
        for each, noise in zip(
            np.split(np.array(rows), 4, axis=1), (NOISE_RAD, 0.0, NOISE_RAD_S, NOISE_NM), strict=True
        )
    )
    t, names = np.arange(len(rows)) * every * STEP_S, tuple(joint.name for joint in spec.joints)
    if torques:
        return Recording(t=t, position=q, velocity=v, motor_torque=torque, names=names)
    return Recording(t=t, position=q, position_command=wanted, names=names)


def case(name: str, effect: str, seed: int, models: Path, every: int, torques: bool) -> Diagnosis:
    """The diagnosis of one arm with one effect, or none."""
    arm, random = ARMS[name], np.random.default_rng(seed)
    spec = nominal(arm, models)
    with tempfile.TemporaryDirectory(prefix="elsewhere-") as folder:
        sim = Path(folder) / "sim.xml"
        sim.write_text(spec.to_xml(), encoding="utf-8")
        if effect:
            (BODIES | JOINTS | SERVOS)[effect](spec, int(random.integers(0, 5)), random)
        made = [recorded(spec, arm, random, every, reaching, torques) for reaching in (True, False, True, False)]
        return diagnose(sim, made[:2], made[2:])


def main() -> int:
    """Diagnose the cases; exit status 1 where a bound is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, default=100.0, help="rows and commands a second")
    parser.add_argument("--torques", action="store_true")
    parser.add_argument("--models", type=Path)
    options = parser.parse_args()
    models = options.models or Path(tempfile.mkdtemp(prefix="elsewhere-models-"))
    if not list(models.glob(f"**/{ARMS['z1'].file}")):
        install = ["install", "--quiet", "--no-deps", "--target", str(models), "example-robot-data"]
        subprocess.run([sys.executable, "-m", "pip", *install], check=True)
    effects = ["", *BODIES, *JOINTS, *({} if options.torques else SERVOS)]
    first, asked, false, alarms, sound = 0, 0, 0, 0, 0
    for k in range(options.cases):
        seed = options.seed * 1000 + k
        random = np.random.default_rng(seed)
        name, effect = list(ARMS)[k % len(ARMS)], effects[int(random.integers(len(effects)))]
        answer = case(name, effect, seed, models, round(1.0 / options.rate / STEP_S), options.torques)
        causes = [(cause.effect, round(cause.confidence, 2)) for cause in answer.causes]
        print(f"{k} {name} {effect or 'none'}: {answer.verdict} {answer.unexplained:.1%} {causes}", flush=True)
        same = {effect, *ALIKE.get(effect, ())}
        false += any(confidence > CONFIDENT and cause not in same for cause, confidence in causes)
        asked, sound = asked + bool(effect), sound + (not effect)
        first += bool(effect) and bool(causes) and causes[0][0] == effect
        alarms += not effect and answer.verdict != "no_gap"
    print(
        f"right first {first} of {asked}, false above {CONFIDENT} in {false}, alarms {alarms} of {sound} without effect"
    )
    return int(first < RIGHT * asked or false > 0 or alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
