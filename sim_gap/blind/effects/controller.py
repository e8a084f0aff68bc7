"""Errors of position servos, and which effects of the arm positions alone show."""

from functools import partial

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, SizedDraw, Values, sign
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


def on_servos(scene: Scene, joints: int | list[int], effect: str, values: Values) -> DrawnEffect:
    """Servos whose law has another value at these joints; effect and value of the law have one name."""
    name, (value,) = effect.removeprefix("controller."), values.values()
    places = np.atleast_1d(joints)

    def change(law: ServoLaw) -> None:
        getattr(law, name)[places] = value

    return DrawnEffect(effect, {scene.arm.names[j]: values for j in places}, law=change)


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    return on_servos(scene, list(range(scene.arm.n)), "controller.delay", {"time": float(random.uniform(0.015, 0.06))})


def stiffness(scene: Scene) -> Array:
    assert scene.law is not None
    return scene.law.stiffness


servo = partial(SizedDraw, make=on_servos)
SIZED = (
    servo("controller.stiffness", "kp", lambda s, r: stiffness(s) * np.exp(sign(r) * r.uniform(0.25, 0.6))),
    servo("controller.slew", "limit", lambda s, r: np.quantile(np.abs(s.motion[1]), r.uniform(0.8, 0.95), axis=0)),
    servo(
        "controller.dead_zone",
        "width",
        lambda s, r: r.uniform(0.25, 0.6) * rms(s.motor_torque) / stiffness(s),
        0.006,
        0.06,
    ),
    servo("controller.integral", "ki", lambda s, r: stiffness(s) * r.uniform(0.5, 2.0)),
)
"""A gain that is not the model's, a command whose rate is limited below the fastest motion, a servo that does not
answer to small errors, an integral part that the model's actuator has not."""
DRAWS: dict[str, Draw] = {"controller.delay": delay, **{each.effect: each for each in SIZED}}
UNKNOWN = (
    "controller.slew",
    "controller.dead_zone",
    *(effect for effect in OF_THE_ARM if effect != "friction.viscous"),
)
"""Effects that count where the model has no controller: the rest belongs to the controller that has to be found, and so
does damping, which a servo makes as well as friction does."""
