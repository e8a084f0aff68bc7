"""Effects of a servo arm: those of the controller, and those of joints and links that positions show."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sim_gap.blind.effects import DRAWS
from sim_gap.blind.effects.drawn_effect import DrawnEffect, Values, pick, sign
from sim_gap.blind.plant.controller import ServoLaw
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

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


@dataclass(frozen=True)
class ServoChange:
    effect: str
    parameters: dict[str, Values]
    arm: Callable[[TrueArm], None] = lambda true: None
    law: Callable[[ServoLaw], None] = lambda law: None
    drawn: DrawnEffect | None = None
    undecided: str = ""
    confused_with: tuple[str, ...] = ()
    implied: tuple[str, ...] = field(default=())


Draw = Callable[[Scene, ServoLaw, np.random.Generator], ServoChange | None]


def stiffness(scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange:
    j = int(random.integers(scene.arm.n))
    factor = float(np.exp(sign(random) * random.uniform(0.25, 0.6)))
    value = float(law.stiffness[j] * factor)

    def apply(true: ServoLaw) -> None:
        true.stiffness[j] *= factor

    return ServoChange("controller.stiffness", {scene.arm.names[j]: {"kp": value}}, law=apply)


def delay(scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange:
    """A command that arrives late at every joint."""
    time = float(random.uniform(0.015, 0.06))

    def apply(true: ServoLaw) -> None:
        true.delay[:] = time

    return ServoChange("controller.delay", {name: {"time": time} for name in scene.arm.names}, law=apply)


def slew(scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange:
    """A command whose rate is limited below the fastest motion."""
    j = int(random.integers(scene.arm.n))
    limit = float(np.quantile(np.abs(scene.motion[1][:, j]), random.uniform(0.8, 0.95)))

    def apply(true: ServoLaw) -> None:
        true.slew[j] = limit

    return ServoChange("controller.slew", {scene.arm.names[j]: {"limit": limit}}, law=apply)


def dead_zone(scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange | None:
    """A servo that does not answer to small errors."""
    usual = rms(scene.torque + scene.rotor_torque) / law.stiffness
    wanted = np.maximum(random.uniform(0.25, 0.6) * usual, 0.006)
    j = pick(wanted, 0.06, random)
    if j is None:
        return None
    width = float(wanted[j])

    def apply(true: ServoLaw) -> None:
        true.dead[j] = width

    return ServoChange("controller.dead_zone", {scene.arm.names[j]: {"width": width}}, law=apply)


def integral(scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange:
    """An integral part that the model's actuator has not."""
    j = int(random.integers(scene.arm.n))
    value = float(law.stiffness[j] * random.uniform(0.5, 2.0))

    def apply(true: ServoLaw) -> None:
        true.integral[j] = value

    return ServoChange("controller.integral", {scene.arm.names[j]: {"ki": value}}, law=apply)


OF_THE_SERVO: dict[str, Draw] = {
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


def draw_effect(effect: str, scene: Scene, law: ServoLaw, random: np.random.Generator) -> ServoChange | None:
    """One effect at a size that shows, None if this arm cannot show it."""
    if effect in OF_THE_SERVO:
        return OF_THE_SERVO[effect](scene, law, random)
    found = DRAWS[effect](scene, random)
    if found is None:
        return None
    return ServoChange(
        effect,
        found.parameters,
        arm=found.apply,
        drawn=found,
        undecided=found.undecided,
        confused_with=found.confused_with,
        implied=found.implied,
    )
