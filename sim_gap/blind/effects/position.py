"""Errors of the position sensors, and delays of the torque readings."""

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, add_to_entry, pick, sensor_level, set_entry, sign
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

PERIOD_S = 0.004
"""Sample interval of the recordings [s]: shorter delays do not show."""


def _felt(scene: Scene, random: np.random.Generator, error: Array) -> Array:
    """Factor (n,) on a joint's position error (K', n) at which some joint's torque shows it."""
    shown = np.stack([rms(scene.slope[:, :, j] * error[:, j, None]) for j in range(scene.arm.n)], axis=1)
    return np.asarray(1.0 / np.maximum((shown / sensor_level(scene, random)[:, None]).max(0), 1e-9))


def offset(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A constant angle: true = read + offset."""
    wanted = _felt(scene, random, np.ones_like(scene.command[::25]))
    j = pick(wanted, 0.12, random)
    if j is None:
        return None
    angle = sign(random) * max(float(wanted[j]), 0.015)
    twins = {0: ("base.tilt",), scene.arm.n - 1: ("link.mass_moment",)}
    why = {
        0: "of joint 1: base tilt does the same",
        scene.arm.n - 1: "of the last joint: its mass moment does the same",
    }
    return DrawnEffect.at(
        scene,
        j,
        "position.offset",
        {"offset": angle},
        add_to_entry(lambda true: true.position_offset, j, angle),
        undecided=why.get(j, ""),
        confused_with=twins.get(j, ()),
    )


def gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Angles scaled: true = gain · read."""
    wanted = _felt(scene, random, scene.motion[0])
    j = pick(wanted, 0.06, random)
    if j is None:
        return None
    value = 1.0 + sign(random) * max(float(wanted[j]), 0.015)
    return DrawnEffect.at(
        scene, j, "position.gain", {"gain": value}, set_entry(lambda true: true.position_gain, j, value)
    )


def eccentricity(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """An error with a period of one turn: true = read + amplitude·sin(read + phase)."""
    phase = random.uniform(-np.pi, np.pi)
    wanted = 1.3 * _felt(scene, random, np.sin(scene.motion[0] + phase))
    far = np.ptp(scene.motion[0], axis=0) > 2.5  # a small part of a turn is an offset and a gain
    j = pick(wanted, 0.08, random, far)
    if j is None:
        return None
    amplitude = max(float(wanted[j]), 0.02)

    def apply(true: TrueArm) -> None:
        true.eccentricity[j] = amplitude, phase

    return DrawnEffect.at(scene, j, "position.eccentricity", {"amplitude": amplitude, "phase": float(phase)}, apply)


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The torque sensor's reading delayed against the position, on one joint or on all."""
    change = np.gradient(scene.torque, 0.05, axis=0)  # every 25th row at 500 Hz
    wanted = np.maximum(sensor_level(scene, random) / rms(change), 2.0 * PERIOD_S)
    j = pick(wanted, 0.04, random)
    if j is None:
        return None
    late = float(wanted[j])
    joints = list(range(scene.arm.n)) if random.random() < 0.25 else [j]

    def apply(true: TrueArm) -> None:
        true.torque_delay[joints] = late

    return DrawnEffect("timing.delay", {scene.arm.names[k]: {"delay": late} for k in joints}, apply)


DRAWS: dict[str, Draw] = {
    "position.offset": offset,
    "position.gain": gain,
    "position.eccentricity": eccentricity,
    "timing.delay": delay,
}
