"""Motors and drives that do not do what they are told, or say."""

import numpy as np

from sim_gap.blind.cases.scene import Scene, rms
from sim_gap.blind.cases.truth import Truth
from sim_gap.blind.effects.drawn import Draw, Drawn, motor_level, pick, sign

LATE_S = (0.008, 0.016)
"""Delays and lags: two to four sample intervals."""
SLOW = "needs steps, a chirp or faster logging"


def gain(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """Torque made per torque reported."""
    wanted = np.maximum(1.3 * motor_level(scene, random) / rms(scene.torque + scene.rotor_torque), 0.07)
    j = pick(wanted, 0.3, random)
    if j is None:
        return None
    value = 1.0 + sign(random) * float(wanted[j])

    def apply(truth: Truth) -> None:
        truth.motor_gain[j] = value

    return Drawn("actuator.gain", {scene.arm.names[j]: {"gain": value}}, apply)


def rotor_inertia(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """A rotor heavier than the nominal model's."""
    wanted = motor_level(scene, random) / rms(scene.motion[2])
    j = pick(wanted, 2.0, random)
    if j is None:
        return None
    added = float(wanted[j])

    def apply(truth: Truth) -> None:
        truth.arm.armature[j] += added

    return Drawn("actuator.rotor_inertia", {scene.arm.names[j]: {"inertia": added}}, apply)


def _late(scene: Scene, random: np.random.Generator) -> tuple[int, float] | None:
    """A joint whose torque changes fast enough for the drawn time to show."""
    time = random.uniform(*LATE_S)
    change = rms(np.gradient(scene.torque + scene.rotor_torque, 0.05, axis=0))
    j = pick(0.1 / np.maximum(change, 1e-9), time, random)
    return None if j is None else (j, float(time))


def lag(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """A first-order lag from command to torque."""
    found = _late(scene, random)
    if found is None:
        return None
    j, time = found

    def apply(truth: Truth) -> None:
        truth.motor_lag[j] = time
        truth.bandwidth[j] = min(truth.bandwidth[j], 0.35 / (1.8 * time))

    return Drawn(
        "actuator.lag", {scene.arm.names[j]: {"time": time}}, apply, undecided=SLOW, confused_with=("actuator.delay",)
    )


def delay(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """A dead time from command to torque."""
    found = _late(scene, random)
    if found is None:
        return None
    j, time = found

    def apply(truth: Truth) -> None:
        truth.motor_delay[j] = time
        truth.bandwidth[j] = min(truth.bandwidth[j], 0.35 / (1.8 * time))

    return Drawn(
        "actuator.delay", {scene.arm.names[j]: {"time": time}}, apply, undecided=SLOW, confused_with=("actuator.lag",)
    )


def saturation(scene: Scene, random: np.random.Generator) -> Drawn | None:
    """The motor clipped: above what holds the arm against gravity, below the peaks of its motion."""
    size = np.abs(scene.torque + scene.rotor_torque)
    hold = np.abs(scene.gravity).max(0)
    limit = np.maximum(1.1 * hold + 0.3, np.quantile(size, random.uniform(0.85, 0.93), axis=0))
    lost = rms(np.maximum(size - limit, 0.0))
    j = pick(1.0 / np.maximum(lost, 1e-9), 1.0 / 0.15, random)
    if j is None:
        return None

    def apply(truth: Truth) -> None:
        truth.motor_limit[j] = limit[j]

    return Drawn("actuator.saturation", {scene.arm.names[j]: {"limit": float(limit[j])}}, apply)


DRAWS: dict[str, Draw] = {
    "actuator.gain": gain,
    "actuator.rotor_inertia": rotor_inertia,
    "actuator.lag": lag,
    "actuator.delay": delay,
    "actuator.saturation": saturation,
}
