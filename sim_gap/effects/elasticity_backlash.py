"""A transmission that gives: the position sensor sits at the motor, and the link stands elsewhere.

The link is at q − δ: δ = τ/K for elasticity; for backlash half the play, to the side that the torque presses to.
"""

from collections.abc import Mapping

import numpy as np
from scipy.signal import butter, sosfiltfilt

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

SMOOTH_HZ = 10.0
"""Pass band of the carried torque before its acceleration is taken."""
NOISY = 0.05
"""Share of the joint's torque (RMS) that a sensor's noise may be for its reading to count."""
SETTLED = 0.02
"""Share of the largest torque within which the play is crossed."""


def carried(signals: Signals, layout: Layout, joint: int) -> Array:
    """Torque through the transmission, smooth, (K,): the sensor's; the model's without one, or where it is noisy.

    The noise of a reading would explain itself.
    """
    model, sensor = signals.model[:, joint], layout.sensor
    clear = sensor and signals.noise[sensor][joint] < NOISY * np.sqrt(np.mean(model**2))
    torque = signals.reading[sensor][:, joint] if sensor and clear else model
    cut = min(SMOOTH_HZ, 0.4 * signals.rate)
    return np.asarray(sosfiltfilt(butter(4, cut, fs=signals.rate, output="sos"), torque))


class Elasticity(Effect):
    """A spring between motor and link; fitted as its compliance."""

    id = "transmission.elasticity"
    parameters = (Parameter("stiffness", "N·m/rad"),)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        bend = carried(signals, layout, place)
        speed = np.gradient(bend, 1.0 / signals.rate)
        moves = bend, speed, np.gradient(speed, 1.0 / signals.rate)
        pairs = zip(signals.sensitivity(place), moves, strict=True)
        change = sum((-slope * move[:, None] for slope, move in pairs), np.zeros_like(signals.q))
        return {(layout.against_model, i): change[:, i, None] for i in range(signals.n)}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(coefficients[0] > 0.0)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return 1.0 / np.maximum(coefficients, 1e-12)


class Backlash(Effect):
    """Play between motor and link: full width."""

    id = "transmission.backlash"
    parameters = (Parameter("width", "rad"),)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        torque = carried(signals, layout, place)
        side = np.clip(torque / (SETTLED * np.abs(torque).max() + 1e-9), -1.0, 1.0)
        change = -0.5 * signals.sensitivity(place)[0] * side[:, None]
        return {(layout.against_model, i): change[:, i, None] for i in range(signals.n)}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(0.0 < coefficients[0] < 0.3)


EFFECTS: tuple[Effect, ...] = (Elasticity(), Backlash())
