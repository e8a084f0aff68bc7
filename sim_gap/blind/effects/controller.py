"""Errors of position servos, and which effects of the arm positions alone show."""

import numpy as np

from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, pick, sign
from sim_gap.blind.scene import Scene, ServoLaw, rms

OF_THE_ARM = (
    "friction.coulomb",
    "friction.viscous",
    "friction.stribeck",
    "friction.load",
    "friction.asymmetric",
    "actuator.saturation",
    "actuator.rotor_inertia",
    "transmission.spring",
    "transmission.backlash",
    "position.offset",
    "link.payload",
    "link.mass_moment",
    "base.tilt",
)
"""Effects of the torque bench that a position shows."""


def _law(scene: Scene) -> ServoLaw:
    assert scene.law is not None
    return scene.law


def _servo(scene: Scene, name: str, parameter: str, joints: list[int], value: float) -> DrawnEffect:
    """A servo whose law has another value at these joints; `name` is both the effect's and the law's."""

    def change(law: ServoLaw) -> None:
        getattr(law, name)[joints] = value

    told = {scene.arm.names[j]: {parameter: value} for j in joints}
    return DrawnEffect(f"controller.{name}", told, law=change)


def stiffness(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    factor = float(np.exp(sign(random) * random.uniform(0.25, 0.6)))
    return _servo(scene, "stiffness", "kp", [j], float(_law(scene).stiffness[j] * factor))


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """A command that arrives late at every joint."""
    return _servo(scene, "delay", "time", list(range(scene.arm.n)), float(random.uniform(0.015, 0.06)))


def slew(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """A command whose rate is limited below the fastest motion."""
    j = int(random.integers(scene.arm.n))
    limit = float(np.quantile(np.abs(scene.motion[1][:, j]), random.uniform(0.8, 0.95)))
    return _servo(scene, "slew", "limit", [j], limit)


def dead_zone(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A servo that does not answer to small errors."""
    usual = rms(scene.torque + scene.rotor_torque) / _law(scene).stiffness
    wanted = np.maximum(random.uniform(0.25, 0.6) * usual, 0.006)
    j = pick(wanted, 0.06, random)
    return None if j is None else _servo(scene, "dead_zone", "width", [j], float(wanted[j]))


def integral(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """An integral part that the model's actuator has not."""
    j = int(random.integers(scene.arm.n))
    return _servo(scene, "integral", "ki", [j], float(_law(scene).stiffness[j] * random.uniform(0.5, 2.0)))


DRAWS: dict[str, Draw] = {
    "controller.stiffness": stiffness,
    "controller.delay": delay,
    "controller.slew": slew,
    "controller.dead_zone": dead_zone,
    "controller.integral": integral,
}
UNKNOWN = (
    "controller.slew",
    "controller.dead_zone",
    *(effect for effect in OF_THE_ARM if effect != "friction.viscous"),
)
"""Effects that count where the model has no controller: the rest belongs to the controller that has to be found, and so
does damping, which a servo makes as well as friction does."""
