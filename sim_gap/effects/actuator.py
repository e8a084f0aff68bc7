"""Errors of motor and drive: the motor torque differs from what the drive reports."""

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Plausibility, Shape, Signature, added_or_taken_off, between


def _gain(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    """Torque produced per torque reported: the error of the torque constant."""
    return 1.0 / (1.0 + coefficients)


def _above_nominal(coefficients: Array, _shape: Shape, beneath: Beneath) -> bool:
    """The rotor may have less inertia than the model's armature."""
    return added_or_taken_off(float(coefficients[0]), float(beneath["nominal"][2]), beneath)


EFFECTS = (
    Effect(  # the whole nominal motor torque: known rotor inertia and friction are scaled too
        "actuator.gain",
        Signature.at_motor(lambda s, j, _: s.motor_model[:, j], "motor", "drive"),
        Plausibility(
            background_std=0.002, prior_std=lambda _signals, _place: np.full(1, 0.5), allows=between(-0.5, 1.0)
        ),
        parameters_of=_gain,
    ),
    Effect(
        "actuator.rotor_inertia",
        Signature.at_motor(lambda s, j, _: s.a[:, j], "motor"),
        Plausibility(prior_penalty=0, allows=_above_nominal),
    ),
)
