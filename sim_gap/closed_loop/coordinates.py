"""The coordinate in which a joint's parameter is fitted: its logarithm, or units of the size at which it is tried."""

from collections.abc import Sequence

import numpy as np

from sim_gap.closed_loop.parameters import PARAMETERS, WITH_TORQUE, Scales

LOGARITHMIC = ("kp", "ki", "limit", "slew", "stribeck_velocity", "gain")
FARTHEST = 1.5
"""Logarithm of the largest factor of one step of a fit."""


def moved(name: str, value: float, step: float, scales: Scales, joint: int, farthest: float = FARTHEST) -> float:
    """A parameter's value after a step in its own coordinate, within its bounds.

    `farthest` is the logarithm of the largest factor on a gain.
    """
    if name in LOGARITHMIC:
        new = value * float(np.exp(np.clip(step, -farthest, farthest)))
    else:
        new = value + step * float(scales.of(name)[joint])
    low, high = PARAMETERS[name].low, PARAMETERS[name].high
    return float(np.clip(new, low, high))


def relative(name: str, value: float, scales: Scales, joint: int) -> float:
    """Step in a parameter's own coordinate per relative change of its value."""
    return 1.0 if name in LOGARITHMIC else value / float(scales.of(name)[joint])


def with_gain(own: Sequence[str]) -> tuple[str, ...]:
    """What of a joint's parameters goes with its gain where all torques change together; none without a gain."""
    return tuple(name for name in own if name in WITH_TORQUE and name != "kp") if "kp" in own else ()
