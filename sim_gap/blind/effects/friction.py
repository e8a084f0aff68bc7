"""Friction of one joint in excess of the nominal model's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim_gap.blind.arms import BenchArm
from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, add_to_entry, motor_level, pick, set_entry, sign
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

LEAST_SPEED = 0.02
"""Speed [rad/s] below which friction does not show in the readings."""


def _known_coulomb(
    joint: int, torque: float, known: bool
) -> tuple[Callable[[BenchArm], BenchArm] | None, tuple[str, ...]]:
    """Coulomb friction under another effect: either the nominal model has it, or it is implied."""

    def nominal(arm: BenchArm) -> BenchArm:
        frictionloss = arm.frictionloss.copy()
        frictionloss[joint] = torque
        return replace(arm, frictionloss=frictionloss)

    return (nominal, ()) if known else (None, ("friction.coulomb",))


def coulomb(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    j = int(random.integers(scene.arm.n))
    torque = float(motor_level(scene, random)[j] * random.uniform(1.0, 2.0))
    return DrawnEffect.at(
        scene, j, "friction.coulomb", {"torque": torque}, add_to_entry(lambda true: true.coulomb, j, torque)
    )


def viscous(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    j = int(random.integers(scene.arm.n))
    damping = float(motor_level(scene, random)[j] * random.uniform(1.0, 2.0) / rms(scene.motion[1])[j])
    return DrawnEffect.at(
        scene, j, "friction.viscous", {"damping": damping}, add_to_entry(lambda true: true.viscous, j, damping)
    )


def stribeck(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """More friction at low speed, in addition to Coulomb friction."""
    j = int(random.integers(scene.arm.n))
    level, speed = float(motor_level(scene, random)[j]), np.abs(scene.motion[1][:, j])
    moving = speed[speed > LEAST_SPEED]
    velocity = float(np.clip(np.quantile(moving, random.uniform(0.25, 0.5)), 0.05, 0.35))
    breakaway = float(1.2 * level / rms(np.exp(-((moving / velocity) ** 2))))
    base = breakaway * random.uniform(0.8, 1.6)
    nominal, implied = _known_coulomb(j, base, bool(random.random() < 0.5))

    def apply(true: TrueArm) -> None:
        true.coulomb[j] = base + 0.02
        true.breakaway[j], true.stribeck_velocity[j] = breakaway, velocity

    values = {"breakaway": breakaway, "velocity": velocity}
    return DrawnEffect.at(scene, j, "friction.stribeck", values, apply, nominal, implied)


def asymmetric(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    j = int(random.integers(scene.arm.n))
    ratio = sign(random) * random.uniform(0.25, 0.6)
    base = float(1.5 * motor_level(scene, random)[j] / abs(ratio))
    nominal, implied = _known_coulomb(j, base, bool(random.random() < 0.5))

    def apply(true: TrueArm) -> None:
        true.coulomb[j], true.asymmetry[j] = base, ratio

    return DrawnEffect.at(scene, j, "friction.asymmetric", {"ratio": ratio}, apply, nominal, implied)


def load(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Friction proportional to the transmitted torque, on a joint whose torque varies."""
    size = np.abs(scene.torque)
    varies = size.std(0) > 0.4 * size.mean(0)
    wanted = 1.5 * motor_level(scene, random) / rms(size)
    j = pick(wanted, 0.35, random, varies & (rms(size) > 3.0))
    if j is None:
        return None
    coefficient = float(wanted[j])
    put = set_entry(lambda true: true.load_friction, j, coefficient)
    return DrawnEffect.at(scene, j, "friction.load", {"coefficient": coefficient}, put)


DRAWS: dict[str, Draw] = {
    "friction.coulomb": coulomb,
    "friction.viscous": viscous,
    "friction.stribeck": stribeck,
    "friction.asymmetric": asymmetric,
    "friction.load": load,
}
