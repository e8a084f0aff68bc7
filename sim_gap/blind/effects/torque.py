"""Torque sensors that mislead."""

import numpy as np

from sim_gap.blind.cases.scene import Scene, rms
from sim_gap.blind.cases.truth import Truth
from sim_gap.blind.effects.drawn import OFTEN, Draw, Drawn, pick, reversals, sensor_level, sign


def offset(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """A constant added to the reading."""
    j = int(random.integers(scene.arm.n))
    value = sign(random) * float(sensor_level(scene, random)[j] * random.uniform(1.0, 2.0))

    def apply(truth: Truth) -> None:
        truth.torque_offset[j] += value

    return Drawn("torque.offset", {scene.arm.names[j]: {"offset": value}}, apply)


def gain(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """The reading scaled."""
    wanted = np.maximum(sensor_level(scene, random) / rms(scene.torque), 0.06)
    j = pick(wanted, 0.25, random)
    if j is None:
        return None
    value = 1.0 + sign(random) * float(wanted[j])

    def apply(truth: Truth) -> None:
        truth.torque_gain[j] *= value

    return Drawn("torque.gain", {scene.arm.names[j]: {"gain": value}}, apply)


def drift(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """An offset that grows with time, from zero when a recording begins."""
    j = int(random.integers(scene.arm.n))
    rate = sign(random) * float(2.5 * sensor_level(scene, random)[j] / scene.seconds)

    def apply(truth: Truth) -> None:
        truth.torque_drift[j] = rate

    return Drawn("torque.drift", {scene.arm.names[j]: {"rate": rate}}, apply)


def crosstalk(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """The reading follows another joint's torque too."""
    size = np.std(scene.torque, axis=0)
    source = int(random.choice(np.flatnonzero(size > 0.4 * size.max())))
    wanted = sensor_level(scene, random) / rms(scene.torque)[source]
    j = pick(wanted, 0.2, random, np.arange(scene.arm.n) != source)
    if j is None:
        return None
    coefficient = sign(random) * float(wanted[j])

    def apply(truth: Truth) -> None:
        truth.crosstalk[j, source] = coefficient

    values = {"coefficient": coefficient, "source": float(source)}
    return Drawn("torque.crosstalk", {scene.arm.names[j]: values}, apply)


def hysteresis(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """The reading stays behind the torque by up to `width`; drawn where the torque swings far beyond it."""
    width = 1.4 * sensor_level(scene, random)
    swing = np.quantile(scene.torque, 0.95, axis=0) - np.quantile(scene.torque, 0.05, axis=0)
    j = pick(width, 0.2 * swing, random)
    if j is None:
        return None

    def apply(truth: Truth) -> None:
        truth.hysteresis[j] = width[j]

    return Drawn("torque.hysteresis", {scene.arm.names[j]: {"width": float(width[j])}}, apply)


def deadband(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """Nothing is read within ±width, and width less beyond; drawn where the torque changes sign often."""
    width = 1.3 * sensor_level(scene, random)
    often = reversals(scene.torque, width) >= OFTEN * scene.seconds
    j = pick(width, 0.4 * rms(scene.torque), random, often)
    if j is None:
        return None

    def apply(truth: Truth) -> None:
        truth.deadband[j] = width[j]

    return Drawn("torque.deadband", {scene.arm.names[j]: {"width": float(width[j])}}, apply)


def saturation(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """The reading clipped at the level that leaves the wanted RMS."""
    level, size = sensor_level(scene, random), np.abs(scene.torque)
    grid = np.linspace(0.98, 0.6, 20)
    limits = np.array([np.quantile(size, q, axis=0) for q in grid])
    lost = np.array([rms(np.maximum(size - limit, 0.0)) for limit in limits])
    enough = np.argmax(lost > level, axis=0)
    j = pick(np.where((lost > level).any(0), 1.0, np.inf), 1.0, random)
    if j is None:
        return None
    limit = float(limits[enough[j], j])

    def apply(truth: Truth) -> None:
        truth.torque_limit = truth.torque_limit.copy()
        truth.torque_limit[j] = limit

    return Drawn("torque.saturation", {scene.arm.names[j]: {"limit": limit}}, apply)


DRAWS: dict[str, Draw] = {
    "torque.offset": offset,
    "torque.gain": gain,
    "torque.drift": drift,
    "torque.crosstalk": crosstalk,
    "torque.hysteresis": hysteresis,
    "torque.deadband": deadband,
    "torque.saturation": saturation,
}
