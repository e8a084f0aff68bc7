"""Errors of the torque and position sensors, and delays of the torque readings."""

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.effects.drawn_effect import OFTEN, ArmSetting, Draw, DrawnEffect, on_joint, pick, reversals, sign
from sim_gap.blind.scene import THINNED_S, Scene, rms

PERIOD_S = 0.004
"""Sample interval of the recordings [s]: shorter delays do not show."""


def torque_offset(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    value = sign(random) * float(scene.sensor_level(random)[j] * random.uniform(1.0, 2.0))
    return on_joint(scene, j, "torque.offset", {"offset": value})


def torque_gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    wanted = np.maximum(scene.sensor_level(random) / rms(scene.torque), 0.06)
    j = pick(wanted, 0.25, random)
    return None if j is None else on_joint(scene, j, "torque.gain", {"gain": 1.0 + sign(random) * float(wanted[j])})


def drift(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """An offset that grows with time, from zero at the start of a recording."""
    j = int(random.integers(scene.arm.n))
    rate = sign(random) * float(2.5 * scene.sensor_level(random)[j] / scene.seconds)
    return on_joint(scene, j, "torque.drift", {"rate": rate})


def crosstalk(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading also follows another joint's torque."""
    size = np.std(scene.torque, axis=0)
    source = int(random.choice(np.flatnonzero(size > 0.4 * size.max())))
    wanted = scene.sensor_level(random) / rms(scene.torque)[source]
    j = pick(wanted, 0.2, random, np.arange(scene.arm.n) != source)
    if j is None:
        return None
    values = {"coefficient": sign(random) * float(wanted[j]), "source": float(source + 1)}
    put = ArmSetting("torque.crosstalk", scene.arm.names[j], {**values, "source": scene.arm.names[source]})
    return on_joint(scene, j, "torque.crosstalk", values, settings=(put,))


def hysteresis(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading lags behind the torque by up to `width`; drawn for a torque that swings far beyond it."""
    widths = 1.4 * scene.sensor_level(random)
    swing = np.quantile(scene.torque, 0.95, axis=0) - np.quantile(scene.torque, 0.05, axis=0)
    j = pick(widths, 0.2 * swing, random)
    return None if j is None else on_joint(scene, j, "torque.hysteresis", {"width": float(widths[j])})


def deadband(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Zero within ±width, and width less beyond; drawn for a torque that changes sign often."""
    widths = 1.3 * scene.sensor_level(random)
    often = reversals(scene.torque, widths) >= OFTEN * scene.seconds
    j = pick(widths, 0.4 * rms(scene.torque), random, often)
    return None if j is None else on_joint(scene, j, "torque.deadband", {"width": float(widths[j])})


def saturation(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The reading clipped at the level that causes the wanted RMS."""
    level, size = scene.sensor_level(random), np.abs(scene.torque)
    limits = np.array([np.quantile(size, q, axis=0) for q in np.linspace(0.98, 0.6, 20)])
    enough = np.greater([rms(np.maximum(size - limit, 0.0)) for limit in limits], level)
    j = pick(np.zeros(scene.arm.n), 0.0, random, np.asarray(enough.any(0)))
    if j is None:
        return None
    return on_joint(scene, j, "torque.saturation", {"limit": float(limits[np.argmax(enough[:, j]), j])})


def _felt(scene: Scene, random: np.random.Generator, error: Array) -> Array:
    """Factor (n,) on a joint's position error (K', n) at which some joint's torque shows it."""
    shown = scene.turn_felt(error) / scene.sensor_level(random)[:, None]
    return np.asarray(1.0 / np.maximum(shown.max(0), 1e-9))


def position_offset(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A constant angle: true = read + offset."""
    wanted, last = _felt(scene, random, np.ones_like(scene.torque)), scene.arm.n - 1
    j = pick(wanted, 0.12, random)
    if j is None:
        return None
    twins = {0: ("of joint 1: base tilt does the same", ("base.tilt",))}
    twins[last] = "of the last joint: its mass moment does the same", ("link.mass_moment",)
    why, others = twins.get(j, ("", ()))
    angle = sign(random) * max(float(wanted[j]), 0.015)
    return on_joint(scene, j, "position.offset", {"offset": angle}, undecided=why, confused_with=others)


def position_gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Angles scaled: true = gain · read."""
    wanted = _felt(scene, random, scene.motion[0])
    j = pick(wanted, 0.06, random)
    if j is None:
        return None
    return on_joint(scene, j, "position.gain", {"gain": 1.0 + sign(random) * max(float(wanted[j]), 0.015)})


def eccentricity(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """An error with a period of one turn: true = read + amplitude·sin(read + phase)."""
    phase = float(random.uniform(-np.pi, np.pi))
    wanted = 1.3 * _felt(scene, random, np.sin(scene.motion[0] + phase))
    far = np.ptp(scene.motion[0], axis=0) > 2.5  # a small part of a turn is an offset and a gain
    j = pick(wanted, 0.08, random, far)
    if j is None:
        return None
    return on_joint(scene, j, "position.eccentricity", {"amplitude": max(float(wanted[j]), 0.02), "phase": phase})


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The torque sensor's reading delayed against the position, on one joint or on all."""
    change = np.gradient(scene.torque, THINNED_S, axis=0)
    wanted = np.maximum(scene.sensor_level(random) / rms(change), 2.0 * PERIOD_S)
    j = pick(wanted, 0.04, random)
    if j is None:
        return None
    names = scene.arm.names if random.random() < 0.25 else (scene.arm.names[j],)
    values = {"delay": float(wanted[j])}
    settings = tuple(ArmSetting("timing.delay", name, values) for name in names)
    return DrawnEffect("timing.delay", dict.fromkeys(names, values), settings)


DRAWS: dict[str, Draw] = {
    "torque.offset": torque_offset,
    "torque.gain": torque_gain,
    "torque.drift": drift,
    "torque.crosstalk": crosstalk,
    "torque.hysteresis": hysteresis,
    "torque.deadband": deadband,
    "torque.saturation": saturation,
    "position.offset": position_offset,
    "position.gain": position_gain,
    "position.eccentricity": eccentricity,
    "timing.delay": delay,
}
