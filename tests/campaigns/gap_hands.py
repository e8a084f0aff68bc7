"""Campaign: a hand that all recordings have and the model lacks, or the reverse, on published arms.

    python tests/campaigns/gap_hands.py [--arms 60] [--seed 1] [--realdata DIR]

Mass moments of several links could take the place of the hand, with more parameters. It has to be the first cause
beside friction, with its mass within 5 %. Torques come from MuJoCo's inverse dynamics along drawn motion, link-side or
with a motor's friction, and have noise. Exit status 1 if fewer than 95 % are right.
"""

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np
from sound_recordings import Motion, inverse, scale_of

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose

MODELS = "ur10e/sim.xml", "panda/sim.xml", "tx40/sim.xml", "lwr4/sim.xml", "ur10/sim.xml", "kinova_gen3/sim.urdf"
SECONDS, RATE, GOAL, MASS = 40.0, 100.0, 0.95, 0.05


def spec_of(path: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.balanceinertia = True
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    return spec


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The arm without friction and rotors."""
    arm = spec.compile()
    for values in (arm.dof_frictionloss, arm.dof_armature, arm.dof_damping):
        values[:] = 0.0
    return arm


def with_hand(path: Path, random: np.random.Generator) -> tuple[mujoco.MjSpec, float]:
    """The arm with a box at its last link, and the box's mass."""
    spec, bare = spec_of(path), spec_of(path).compile()
    last = bare.jnt_bodyid[bare.njnt - 1]
    mass, axis = float(random.uniform(0.015, 0.08) * bare.body_mass.sum()), bare.jnt_axis[bare.njnt - 1]
    outward = np.sign(axis @ bare.body_ipos[last]) or 1.0
    at = random.normal(0.0, 0.015, 3) + outward * random.uniform(0.05, 0.15) * axis
    size = random.uniform(0.03, 0.07, 3)
    hand = next(body for body in spec.bodies if body.name == bare.body(last).name).add_body(name="hand_", pos=at)
    hand.mass, hand.inertia, hand.explicitinertial = mass, mass / 3.0 * (np.sum(size**2) - size**2), True
    return spec, mass


def motion(random: np.random.Generator, arm: mujoco.MjModel) -> tuple[np.ndarray, Motion]:
    t, n = np.arange(0.0, SECONDS, 1.0 / RATE), arm.nv
    low, high = (np.where(arm.jnt_limited, arm.jnt_range[:, k], end) for k, end in ((0, -2.5), (1, 2.5)))
    reach = np.minimum(0.35 * (high - low), 0.9)
    w, phase = 2.0 * np.pi * random.uniform(0.05, 0.45, (4, n)), random.uniform(0.0, 2.0 * np.pi, (4, n))
    share = random.uniform(0.3, 1.0, (4, n))
    share, x = reach * share / share.sum(0), w * t[:, None, None] + phase
    q, v, a = share * np.sin(x), share * w * np.cos(x), -share * w**2 * np.sin(x)
    return t, (np.clip(0.5 * (low + high), -1.5, 1.5) + q.sum(1), v.sum(1), a.sum(1))


def one(path: Path, random: np.random.Generator) -> tuple[bool, str]:
    """One arm: whether the hand came out, and a line."""
    held, mass = with_hand(path, random)
    missing, motor = random.random() < 0.5, random.random() < 0.5
    nominal, real = (held, spec_of(path)) if missing else (spec_of(path), held)
    arm, made = compiled(real), []
    coulomb, viscous = random.uniform(0.03, 0.15, (2, arm.nv))
    ways = [motion(random, arm) for _ in range(2)]
    usual = scale_of(inverse(arm, ways[0][1]))
    for t, way in ways:
        torque = inverse(arm, way)
        if motor:
            torque = torque + usual * (coulomb * np.tanh(way[1] / 0.01) + viscous * way[1])
        torque = torque + 0.004 * usual * random.normal(size=torque.shape)
        position = way[0] + random.normal(0.0, 2e-5, way[0].shape)
        names = tuple(arm.joint(k).name for k in range(arm.nv))
        made.append(Recording(t=t, position=position, names=names, **{"motor_torque" if motor else "torque": torque}))
    answer = diagnose(compiled(nominal), made[:1], made[1:])
    first = next((cause for cause in answer.causes if not cause.effect.startswith("friction.")), None)
    found = first.parameters["arm"]["mass"].value if first and first.effect == "link.payload" else np.nan
    true = -mass if missing else mass
    good = bool(abs(found - true) < MASS * mass)
    return (
        good,
        f"{path.parent.name} {'motor' if motor else 'link'} torque, {true:+.3f} kg: {found:+.3f}, {answer.verdict}",
    )


def main() -> int:
    """Diagnose all draws."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--arms", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--realdata", type=Path, default=Path(__file__).parents[3] / "shared" / "realdata")
    given, right = parser.parse_args(), 0
    for number in range(given.arms):
        path = given.realdata / MODELS[number % len(MODELS)]
        good, line = one(path, np.random.default_rng([given.seed, number]))
        right += good
        print(f"{'ok ' if good else 'NOT'} {line}", flush=True)
    print(f"{right} of {given.arms} with the hand first, its mass within {MASS:.0%}")
    return int(right < GOAL * given.arms)


if __name__ == "__main__":
    sys.exit(main())
