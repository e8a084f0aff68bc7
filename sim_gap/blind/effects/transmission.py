"""Gears: ripple, a spring across the joint, elasticity, backlash, a motor coupled to two joints."""

from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.effects.drawn_effect import (
    OFTEN,
    Draw,
    DrawnEffect,
    motor_level,
    pick,
    reversals,
    sensor_level,
    set_entry,
    sign,
)
from sim_gap.blind.plant.plant import STEP
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import SharedMotor, TrueArm

LEAST_ELASTIC_NM = 0.25
"""Least RMS torque caused by the deflection of an elastic joint [N·m]."""


def ripple(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Torque lost to the meshing gear: amplitude·sin(cycles·θ + phase), slow enough to pass a 6 Hz filter."""
    fastest = np.quantile(np.abs(scene.motion[1]), 0.9, axis=0)
    j = int(random.integers(scene.arm.n))
    most = max(8.0, min(30.0, 2 * np.pi * 4.0 / max(float(fastest[j]), 0.1)))
    values = {
        "amplitude": float(1.5 * motor_level(scene, random)[j]),
        "cycles": float(random.uniform(6.0, most)),
        "phase": float(random.uniform(-np.pi, np.pi)),
    }

    def apply(true: TrueArm) -> None:
        true.ripple[j] = list(values.values())

    return DrawnEffect.at(scene, j, "transmission.ripple", values, apply)


def spring(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A cable bundle across the joint: −stiffness·(θ − rest) on the link."""
    q = scene.motion[0]
    wanted = 1.3 * np.maximum(sensor_level(scene, random), 0.2) / q.std(0)
    j = int(random.integers(scene.arm.n))
    rest = float(q[:, j].mean() + random.uniform(-0.5, 0.5) * q[:, j].std())
    stiffness = float(wanted[j])

    def apply(true: TrueArm) -> None:
        true.spring[j] = stiffness, rest

    return DrawnEffect.at(scene, j, "transmission.spring", {"stiffness": stiffness, "rest": rest}, apply)


def _turn_felt(scene: Scene, error: Array) -> Array:
    """RMS torque at the most affected joint caused by an angle error (K', n) of each joint, (n,)."""
    return np.array([rms(scene.slope[:, :, j] * error[:, j, None]).max() for j in range(scene.arm.n)])


def elasticity(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Rotor and link with a spring between them; the position sensor is at the rotor."""
    stiffness_of = rms(scene.torque) / random.uniform(0.015, 0.04)  # from the RMS deflection [rad]
    resonance, stiffest = (2 * np.pi * 4.0) ** 2 * scene.inertia, _stiffest(scene)
    shown = _turn_felt(scene, scene.torque / stiffness_of)
    fit = (shown > LEAST_ELASTIC_NM) & (stiffness_of > resonance) & (stiffness_of < stiffest)
    if not fit.any():
        return None
    j = int(random.choice(np.flatnonzero(fit)))
    stiffness = float(stiffness_of[j])
    put = set_entry(lambda true: true.stiffness, j, stiffness)
    return DrawnEffect.at(scene, j, "transmission.elasticity", {"stiffness": stiffness}, put)


def backlash(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Backlash between rotor and link, on a joint whose torque changes sign often."""
    level = np.maximum(sensor_level(scene, random), 0.2)
    wanted = 2.2 * level / np.maximum(_turn_felt(scene, np.ones_like(scene.torque)), 1e-9)
    often = reversals(scene.torque, 0.1 * rms(scene.torque)) >= OFTEN * scene.seconds
    j = pick(wanted, 0.07, random, often)
    if j is None:
        return None
    play, stiffness = max(float(wanted[j]), 0.01), float(_stiffest(scene)[j])

    def apply(true: TrueArm) -> None:
        true.backlash[j], true.stiffness[j] = play, stiffness

    return DrawnEffect.at(scene, j, "transmission.backlash", {"width": play}, apply)


def _stiffest(scene: Scene) -> Array:
    """Stiffness of a stiff gear that the time step still resolves, (n,)."""
    link = np.maximum(scene.inertia - scene.arm.armature, 2e-3)
    reduced = link * scene.arm.armature / (link + scene.arm.armature)
    return np.asarray(np.minimum(0.04 * reduced / STEP**2, 4e4))


def coupling(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The motor of a joint also turns with its neighbour; the nominal model does not have that motor."""
    n = scene.arm.n
    j = int(random.integers(1, n))
    k = j - 1 if j == n - 1 or random.random() < 0.7 else j + 1
    coefficient = sign(random) * (1.0 if random.random() < 0.6 else float(random.uniform(0.5, 0.9)))
    speed, push = (x[:, j] + coefficient * x[:, k] for x in scene.motion[1:])
    level = float(motor_level(scene, random)[[j, k]].max())
    coulomb, viscous = 1.5 * level, 0.8 * level / float(rms(speed))
    rotor = 0.5 * level / float(rms(push))

    def nominal(arm: BenchArm) -> BenchArm:
        out = replace(
            arm, armature=arm.armature.copy(), damping=arm.damping.copy(), frictionloss=arm.frictionloss.copy()
        )
        out.armature[j], out.damping[j], out.frictionloss[j] = 0.0, 0.0, 0.0
        return out

    def apply(true: TrueArm) -> None:
        true.shared.append(SharedMotor(j, k, coefficient, rotor))
        true.coulomb[j] += coulomb
        true.viscous[j] += viscous

    values = {
        "coefficient": coefficient,
        "other_joint": float(k + 1),
        "inertia": rotor,
        "coulomb": coulomb,
        "viscous": viscous,
    }
    own = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia")
    return DrawnEffect.at(scene, j, "transmission.coupling", values, apply, nominal, own)


DRAWS: dict[str, Draw] = {
    "transmission.ripple": ripple,
    "transmission.spring": spring,
    "transmission.elasticity": elasticity,
    "transmission.backlash": backlash,
    "transmission.coupling": coupling,
}
