"""A transmission that gives: the position sensor is at the motor, and the link is at another angle.

The link is at q − δ: δ = τ/K for elasticity; for backlash half the play, in the direction of the transmitted torque.
"""

import numpy as np
from scipy.signal import butter, sosfiltfilt

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Plausibility, Shape, between, positive
from sim_gap.effects.position import moving
from sim_gap.residuals.layout import Layout
from sim_gap.residuals.preprocess import Signals

SMOOTH_HZ = 10.0
"""Pass band of the transmitted torque before its acceleration is taken."""
NOISY = 0.05
"""Largest noise of a sensor, as a share of the joint's torque (RMS), for its reading to be used."""
SETTLED = 0.02
"""Share of the largest torque within which the play is crossed."""


def transmitted(signals: Signals, layout: Layout, joint: int) -> Array:
    """Torque through the transmission, smooth, (K,): the sensor's; the model's if there is none or it is noisy.

    Noise of the reading would explain itself.
    """
    model, sensor = signals.model[:, joint], layout.sensor
    clear = sensor and signals.noise[sensor][joint] < NOISY * np.sqrt(np.mean(model**2))
    torque = signals.reading[sensor][:, joint] if sensor and clear else model
    cut = min(SMOOTH_HZ, 0.4 * signals.rate)
    return np.asarray(sosfiltfilt(butter(4, cut, fs=signals.rate, output="sos"), torque))


def _bend(signals: Signals, layout: Layout, place: int) -> Array:
    """A spring between motor and link; the coefficient is its compliance."""
    bend = transmitted(signals, layout, place)
    speed = np.gradient(bend, 1.0 / signals.rate)
    return -np.stack([bend, speed, np.gradient(speed, 1.0 / signals.rate)], axis=-1)[:, None]


def _play(signals: Signals, layout: Layout, place: int) -> Array:
    """Play between motor and link; the coefficient is its full width."""
    torque = transmitted(signals, layout, place)
    side = np.clip(torque / (SETTLED * np.abs(torque).max() + 1e-9), -1.0, 1.0)
    return -0.5 * np.stack([side, 0.0 * side, 0.0 * side], axis=-1)[:, None]


def _stiffness(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    return 1.0 / np.maximum(coefficients, 1e-12)


EFFECTS = (
    Effect("transmission.elasticity", moving(_bend), Plausibility(allows=positive), parameters_of=_stiffness),
    Effect("transmission.backlash", moving(_play), Plausibility(allows=between(0.0, 0.3))),
)
