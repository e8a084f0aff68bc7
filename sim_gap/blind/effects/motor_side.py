"""Friction, gears, motors and drives: effects on the motor's side of the torque sensor."""

from functools import partial
from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.effects.drawn_effect import OFTEN, ArmSetting, Draw, DrawnEffect, on_joint, pick, reversals, sign
from sim_gap.blind.scene import THINNED_S, Scene, rms

LEAST_SPEED = 0.02
"""Speed [rad/s] below which friction does not show in the readings."""
LEAST_ELASTIC_NM = 0.25
"""Least RMS torque caused by the deflection of an elastic joint [N·m]."""
LEAST_ROTOR_SHARE = 0.12
"""Least rotor inertia behind a spring, as a share of its joint's: the simulated arm has none below a tenth."""
LATE_S = (0.008, 0.016)
"""Delays and lags [s]: two to four sample intervals."""
SLOW = "needs steps, a chirp or faster logging"


def coulomb(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    return on_joint(
        scene, j, "friction.coulomb", {"torque": float(scene.motor_level(random)[j] * random.uniform(1.0, 2.0))}
    )


def viscous(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    damping = float(scene.motor_level(random)[j] * random.uniform(1.0, 2.0) / rms(scene.motion[1])[j])
    return on_joint(scene, j, "friction.viscous", {"damping": damping})


def _on_coulomb(
    scene: Scene, random: np.random.Generator, j: int, torque: float, effect: str, values: dict[str, float]
) -> DrawnEffect:
    """An effect on top of Coulomb friction [N·m], which the nominal model has, or which is implied."""
    name = scene.arm.names[j]
    settings = ArmSetting("friction.coulomb", name, {"torque": torque}), ArmSetting(effect, name, values)
    if random.random() < 0.5:
        return on_joint(scene, j, effect, values, nominal=lambda arm: arm.with_entry("frictionloss", j, torque))
    return on_joint(scene, j, effect, values, settings=settings, implied=("friction.coulomb",))


def stribeck(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """More friction at low speed, in addition to Coulomb friction."""
    j = int(random.integers(scene.arm.n))
    level, speed = float(scene.motor_level(random)[j]), np.abs(scene.motion[1][:, j])
    moving = speed[speed > LEAST_SPEED]
    velocity = float(np.clip(np.quantile(moving, random.uniform(0.25, 0.5)), 0.05, 0.35))
    breakaway = float(1.2 * level / rms(np.exp(-((moving / velocity) ** 2))))
    values = {"breakaway": breakaway, "velocity": velocity}
    return _on_coulomb(scene, random, j, breakaway * random.uniform(0.8, 1.6), "friction.stribeck", values)


def asymmetric(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    ratio = sign(random) * random.uniform(0.25, 0.6)
    base = float(1.5 * scene.motor_level(random)[j] / abs(ratio))
    return _on_coulomb(scene, random, j, base, "friction.asymmetric", {"ratio": ratio})


def load(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Friction proportional to the transmitted torque, on a joint whose torque varies."""
    size = np.abs(scene.torque)
    varies = size.std(0) > 0.4 * size.mean(0)
    wanted = 1.5 * scene.motor_level(random) / rms(size)
    j = pick(wanted, 0.35, random, varies & (rms(size) > 3.0))
    return None if j is None else on_joint(scene, j, "friction.load", {"coefficient": float(wanted[j])})


def ripple(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """Torque lost to the meshing gear: amplitude·sin(cycles·θ + phase), slow enough to pass a 6 Hz filter."""
    j = int(random.integers(scene.arm.n))
    fastest = float(np.quantile(np.abs(scene.motion[1][:, j]), 0.9))
    most = max(8.0, min(30.0, 2 * np.pi * 4.0 / max(fastest, 0.1)))
    values = {
        "amplitude": float(1.5 * scene.motor_level(random)[j]),
        "cycles": float(random.uniform(6.0, most)),
        "phase": float(random.uniform(-np.pi, np.pi)),
    }
    return on_joint(scene, j, "transmission.ripple", values)


def spring(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """A cable bundle across the joint: −stiffness·(θ − rest) on the link."""
    j = int(random.integers(scene.arm.n))
    q = scene.motion[0][:, j]
    stiffness = float(1.3 * max(scene.sensor_level(random)[j], 0.2) / q.std())
    rest = float(q.mean() + random.uniform(-0.5, 0.5) * q.std())
    return on_joint(scene, j, "transmission.spring", {"stiffness": stiffness, "rest": rest})


def _heavy_rotor(scene: Scene, j: int) -> dict[str, Any]:
    """The nominal arm with a rotor that a spring can carry, as a field of DrawnEffect."""
    link = scene.link_inertia[j]
    least = LEAST_ROTOR_SHARE / (1.0 - LEAST_ROTOR_SHARE) * link
    return {"nominal": lambda arm: arm.with_entry("armature", j, max(float(arm.armature[j]), float(least)))}


def elasticity(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Rotor and link with a spring between them; the position sensor is at the rotor."""
    stiffness = rms(scene.torque) / random.uniform(0.015, 0.04)  # from the RMS deflection [rad]
    shown = scene.turn_felt(scene.torque / stiffness).max(0) > LEAST_ELASTIC_NM
    j = pick((2 * np.pi * 4.0) ** 2 * scene.inertia, stiffness, random, shown)  # resonance above 4 Hz
    if j is None:
        return None
    values = {"stiffness": float(stiffness[j])}
    return on_joint(scene, j, "transmission.elasticity", values, **_heavy_rotor(scene, j))


def backlash(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Backlash between rotor and link, on a joint whose torque changes sign often."""
    level = np.maximum(scene.sensor_level(random), 0.2)
    wanted = 2.2 * level / np.maximum(scene.turn_felt(np.ones_like(scene.torque)).max(0), 1e-9)
    often = reversals(scene.torque, 0.1 * rms(scene.torque)) >= OFTEN * scene.seconds
    j = pick(wanted, 0.07, random, often)
    if j is None:
        return None
    values = {"width": max(float(wanted[j]), 0.01)}
    return on_joint(scene, j, "transmission.backlash", values, **_heavy_rotor(scene, j))


def coupling(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """The motor of a joint also turns with its neighbour; the nominal model does not have that motor."""
    n, names = scene.arm.n, scene.arm.names
    j = int(random.integers(1, n))
    k = j - 1 if j == n - 1 or random.random() < 0.7 else j + 1
    coefficient = sign(random) * (1.0 if random.random() < 0.6 else float(random.uniform(0.5, 0.9)))
    speed, push = (x[:, j] + coefficient * x[:, k] for x in scene.motion[1:])
    level = float(scene.motor_level(random)[[j, k]].max())
    rotor, coulomb, viscous = 0.5 * level / float(rms(push)), 1.5 * level, 0.8 * level / float(rms(speed))
    settings = (
        ArmSetting("transmission.coupling", names[j], {"coefficient": coefficient, "source": names[k]}),
        ArmSetting("actuator.rotor_inertia", names[j], {"inertia": rotor}),
        ArmSetting("friction.coulomb", names[j], {"torque": coulomb}),
        ArmSetting("friction.viscous", names[j], {"damping": viscous}),
    )

    def without_motor(arm: BenchArm) -> BenchArm:
        return arm.with_entry("armature", j, 0.0).with_entry("damping", j, 0.0).with_entry("frictionloss", j, 0.0)

    own = {"inertia": rotor, "coulomb": coulomb, "viscous": viscous}
    values = {"coefficient": coefficient, "other_joint": float(k + 1), **own}
    implied = tuple(setting.effect for setting in settings[1:])
    return on_joint(
        scene, j, "transmission.coupling", values, settings=settings, nominal=without_motor, implied=implied
    )


def gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    wanted = np.maximum(1.3 * scene.motor_level(random) / rms(scene.torque + scene.rotor_torque), 0.07)
    j = pick(wanted, 0.3, random)
    return None if j is None else on_joint(scene, j, "actuator.gain", {"gain": 1.0 + sign(random) * float(wanted[j])})


def rotor_inertia(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A rotor inertia larger than the nominal model's."""
    wanted = scene.motor_level(random) / rms(scene.motion[2])
    j = pick(wanted, 2.0, random)
    return None if j is None else on_joint(scene, j, "actuator.rotor_inertia", {"inertia": float(wanted[j])})


def late(scene: Scene, random: np.random.Generator, effect: str, other: str) -> DrawnEffect | None:
    """A lag or delay of the drive, at a joint whose torque changes fast enough to show it; slow motion confuses it with
    the `other`."""
    time = float(random.uniform(*LATE_S))
    change = rms(np.gradient(scene.torque + scene.rotor_torque, THINNED_S, axis=0))
    j = pick(0.1 / np.maximum(change, 1e-9), time, random)
    return None if j is None else on_joint(scene, j, effect, {"time": time}, undecided=SLOW, confused_with=(other,))


def saturation(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The motor torque clipped: above the torque that holds the arm against gravity, below the peaks of its motion."""
    size: Array = np.abs(scene.torque + scene.rotor_torque)
    limits = np.maximum(1.1 * np.abs(scene.gravity).max(0) + 0.3, np.quantile(size, random.uniform(0.85, 0.93), axis=0))
    lost = rms(np.maximum(size - limits, 0.0))
    j = pick(-lost, -0.15, random)
    return None if j is None else on_joint(scene, j, "actuator.saturation", {"limit": float(limits[j])})


DRAWS: dict[str, Draw] = {
    "friction.coulomb": coulomb,
    "friction.viscous": viscous,
    "friction.stribeck": stribeck,
    "friction.asymmetric": asymmetric,
    "friction.load": load,
    "transmission.ripple": ripple,
    "transmission.spring": spring,
    "transmission.elasticity": elasticity,
    "transmission.backlash": backlash,
    "transmission.coupling": coupling,
    "actuator.gain": gain,
    "actuator.rotor_inertia": rotor_inertia,
    "actuator.lag": partial(late, effect="actuator.lag", other="actuator.delay"),
    "actuator.delay": partial(late, effect="actuator.delay", other="actuator.lag"),
    "actuator.saturation": saturation,
}
