"""Motors and drives whose torque differs from the command or from the reported torque."""

import numpy as np

from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, add_to_entry, motor_level, pick, set_entry, sign
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

LATE_S = (0.008, 0.016)
"""Delays and lags [s]: two to four sample intervals."""
SLOW = "needs steps, a chirp or faster logging"


def gain(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    wanted = np.maximum(1.3 * motor_level(scene, random) / rms(scene.torque + scene.rotor_torque), 0.07)
    j = pick(wanted, 0.3, random)
    if j is None:
        return None
    value = 1.0 + sign(random) * float(wanted[j])
    return DrawnEffect.at(scene, j, "actuator.gain", {"gain": value}, set_entry(lambda arm: arm.motor_gain, j, value))


def rotor_inertia(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A rotor inertia larger than the nominal model's."""
    wanted = motor_level(scene, random) / rms(scene.motion[2])
    j = pick(wanted, 2.0, random)
    if j is None:
        return None
    inertia = float(wanted[j])
    put = add_to_entry(lambda true: true.arm.armature, j, inertia)
    return DrawnEffect.at(scene, j, "actuator.rotor_inertia", {"inertia": inertia}, put)


def _late(scene: Scene, random: np.random.Generator, effect: str, other: str) -> DrawnEffect | None:
    """A lag or delay of the drive, at a joint whose torque changes fast enough to show it; slow motion confuses it with
    the `other`."""
    time = float(random.uniform(*LATE_S))
    change = rms(np.gradient(scene.torque + scene.rotor_torque, 0.05, axis=0))
    j = pick(0.1 / np.maximum(change, 1e-9), time, random)
    if j is None:
        return None

    def apply(true: TrueArm) -> None:
        times = true.motor_lag if effect == "actuator.lag" else true.motor_delay
        times[j] = time
        true.bandwidth[j] = min(true.bandwidth[j], 0.35 / (1.8 * time))

    return DrawnEffect.at(scene, j, effect, {"time": time}, apply, undecided=SLOW, confused_with=(other,))


def lag(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    return _late(scene, random, "actuator.lag", "actuator.delay")


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    return _late(scene, random, "actuator.delay", "actuator.lag")


def saturation(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The motor torque clipped: above the torque that holds the arm against gravity, below the peaks of its motion."""
    size = np.abs(scene.torque + scene.rotor_torque)
    hold = np.abs(scene.gravity).max(0)
    limits = np.maximum(1.1 * hold + 0.3, np.quantile(size, random.uniform(0.85, 0.93), axis=0))
    lost = rms(np.maximum(size - limits, 0.0))
    j = pick(1.0 / np.maximum(lost, 1e-9), 1.0 / 0.15, random)
    if j is None:
        return None
    limit = float(limits[j])
    return DrawnEffect.at(
        scene, j, "actuator.saturation", {"limit": limit}, set_entry(lambda true: true.motor_limit, j, limit)
    )


DRAWS: dict[str, Draw] = {
    "actuator.gain": gain,
    "actuator.rotor_inertia": rotor_inertia,
    "actuator.lag": lag,
    "actuator.delay": delay,
    "actuator.saturation": saturation,
}
