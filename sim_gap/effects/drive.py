"""Errors of motor and drive: the motor torque differs from what the drive reports, or does not follow the command.

What does not follow the command shows in it against the drive's own estimate; if a recording has a command but no
estimate, against the sensor or the model.
"""

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from gcomp.arrays import Array
from sim_gap.effects.effect import (
    CUT_OFF,
    InverseEffect,
    Plausibility,
    SearchHints,
    Signature,
    delay_effect,
    exceeded_levels,
)

LONGEST = 0.2
"""Longest time that counts as a lag or delay [s]."""


def _missing(lost: Callable[[Array, float, float], Array]) -> Signature:
    """Command less motor torque, `lost(command (K,), shape, rate)`."""
    return Signature.at_command(lambda s, joint, shape: lost(s.reading["tau_cmd"][:, joint], shape[0], s.rate))


def _lag(command: Array, time: float, rate: float) -> Array:
    """First-order lag by the trapezoidal rule, whose lag is exactly `time` even if it spans few samples."""
    pole = (2.0 * rate * time - 1.0) / (2.0 * rate * time + 1.0)
    gain = 0.5 * (1.0 - pole)
    follow, _ = lfilter([gain, gain], [1.0, -pole], command, zi=[(1.0 - gain) * command[0]])
    return np.asarray(command - follow)


def _delay(command: Array, time: float, rate: float) -> Array:
    t = np.arange(len(command)) / rate
    return np.asarray(command - np.interp(t - time, t, command))


def _clipped(command: Array, limit: float, _rate: float) -> Array:
    return np.asarray(command - np.clip(command, -limit, limit))


EFFECTS = (
    InverseEffect(  # the whole nominal motor torque: known rotor inertia and friction are scaled too
        "actuator.gain",
        Signature.at_motor(lambda s, j, _: s.motor_model[:, j], "motor", "drive"),
        Plausibility(background_std=0.002, prior_std=0.5, bounds=(-0.5, 1.0)),
        parameters_of=lambda c, _shape, _: 1.0 / (1.0 + c),  # torque produced per torque reported
    ),
    InverseEffect(  # the rotor may have less inertia than the model's armature
        "actuator.rotor_inertia",
        Signature.at_motor(lambda s, j, _: s.a[:, j], "motor", of_motion=True),
        Plausibility(
            every_joint=True,
            # geared drives are matched to their load within a factor of some
            prior_std=lambda signals, _place: signals.arm.stretched_inertia,
            bounds=lambda ratings, _shape: (-ratings.armature, np.inf),
        ),
    ),
    delay_effect("actuator.lag", _missing(_lag), 0.01, LONGEST),
    delay_effect("actuator.delay", _missing(_delay), 0.01, LONGEST),
    InverseEffect(
        "actuator.saturation",
        _missing(_clipped),
        CUT_OFF,
        SearchHints(shapes_for=exceeded_levels(lambda s, joint: s.reading["tau_cmd"][:, joint])),
        parameters_of=lambda _, shape, _beneath: [shape[0]],
    ),
)
