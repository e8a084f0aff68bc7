"""Errors of the torque sensors."""

import numpy as np

from sim_gap.blind.effects.drawn_effect import (
    OFTEN,
    Draw,
    DrawnEffect,
    add_to_entry,
    pick,
    reversals,
    sensor_level,
    set_entry,
    sign,
)
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm


def offset(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    j = int(random.integers(scene.arm.n))
    value = sign(random) * float(sensor_level(scene, random)[j] * random.uniform(1.0, 2.0))
    return DrawnEffect.at(
        scene, j, "torque.offset", {"offset": value}, add_to_entry(lambda true: true.torque_offset, j, value)
    )


def gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    wanted = np.maximum(sensor_level(scene, random) / rms(scene.torque), 0.06)
    j = pick(wanted, 0.25, random)
    if j is None:
        return None
    value = 1.0 + sign(random) * float(wanted[j])

    def apply(true: TrueArm) -> None:
        true.torque_gain[j] *= value

    return DrawnEffect.at(scene, j, "torque.gain", {"gain": value}, apply)


def drift(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """An offset that grows with time, from zero at the start of a recording."""
    j = int(random.integers(scene.arm.n))
    rate = sign(random) * float(2.5 * sensor_level(scene, random)[j] / scene.seconds)
    return DrawnEffect.at(scene, j, "torque.drift", {"rate": rate}, set_entry(lambda true: true.torque_drift, j, rate))


def crosstalk(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading also follows another joint's torque."""
    size = np.std(scene.torque, axis=0)
    source = int(random.choice(np.flatnonzero(size > 0.4 * size.max())))
    wanted = sensor_level(scene, random) / rms(scene.torque)[source]
    j = pick(wanted, 0.2, random, np.arange(scene.arm.n) != source)
    if j is None:
        return None
    coefficient = sign(random) * float(wanted[j])
    values = {"coefficient": coefficient, "source": float(source + 1)}
    return DrawnEffect.at(
        scene, j, "torque.crosstalk", values, set_entry(lambda true: true.crosstalk[:, source], j, coefficient)
    )


def hysteresis(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading lags behind the torque by up to `width`; drawn for a torque that swings far beyond it."""
    widths = 1.4 * sensor_level(scene, random)
    swing = np.quantile(scene.torque, 0.95, axis=0) - np.quantile(scene.torque, 0.05, axis=0)
    j = pick(widths, 0.2 * swing, random)
    if j is None:
        return None
    width = float(widths[j])
    return DrawnEffect.at(
        scene, j, "torque.hysteresis", {"width": width}, set_entry(lambda true: true.hysteresis, j, width)
    )


def deadband(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Zero within ±width, and width less beyond; drawn for a torque that changes sign often."""
    widths = 1.3 * sensor_level(scene, random)
    often = reversals(scene.torque, widths) >= OFTEN * scene.seconds
    j = pick(widths, 0.4 * rms(scene.torque), random, often)
    if j is None:
        return None
    width = float(widths[j])
    return DrawnEffect.at(
        scene, j, "torque.deadband", {"width": width}, set_entry(lambda true: true.deadband, j, width)
    )


def saturation(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading clipped at the level that causes the wanted RMS."""
    level, size = sensor_level(scene, random), np.abs(scene.torque)
    grid = np.linspace(0.98, 0.6, 20)
    limits = np.array([np.quantile(size, q, axis=0) for q in grid])
    lost = np.array([rms(np.maximum(size - limit, 0.0)) for limit in limits])
    enough = np.argmax(lost > level, axis=0)
    j = pick(np.where((lost > level).any(0), 1.0, np.inf), 1.0, random)
    if j is None:
        return None
    limit = float(limits[enough[j], j])

    def apply(true: TrueArm) -> None:
        true.torque_limit = true.torque_limit.copy()
        true.torque_limit[j] = limit

    return DrawnEffect.at(scene, j, "torque.saturation", {"limit": limit}, apply)


DRAWS: dict[str, Draw] = {
    "torque.offset": offset,
    "torque.gain": gain,
    "torque.drift": drift,
    "torque.crosstalk": crosstalk,
    "torque.hysteresis": hysteresis,
    "torque.deadband": deadband,
    "torque.saturation": saturation,
}
