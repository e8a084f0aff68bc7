"""A transmission that gives: the position sensor is at the motor, and the link is at another angle.

The link is at q − δ: δ = τ/K for elasticity; for backlash half the play, in the direction of the transmitted torque.
"""

import numpy as np
from scipy.signal import butter, sosfiltfilt

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Plausibility, Shape, Signature, between, positive
from sim_gap.residuals.layout import Columns, Layout
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


def _elasticity(signals: Signals, layout: Layout, place: int, _shape: Shape) -> Columns:
    """A spring between motor and link; the coefficient is its compliance."""
    bend = transmitted(signals, layout, place)
    speed = np.gradient(bend, 1.0 / signals.rate)
    moves = bend, speed, np.gradient(speed, 1.0 / signals.rate)
    pairs = zip(signals.sensitivity(place), moves, strict=True)
    change = sum((-slope * move[:, None] for slope, move in pairs), np.zeros_like(signals.q))
    return {(layout.against_model, i): change[:, i, None] for i in range(signals.n)}


def _backlash(signals: Signals, layout: Layout, place: int, _shape: Shape) -> Columns:
    """Play between motor and link; the coefficient is its full width."""
    torque = transmitted(signals, layout, place)
    side = np.clip(torque / (SETTLED * np.abs(torque).max() + 1e-9), -1.0, 1.0)
    change = -0.5 * signals.sensitivity(place)[0] * side[:, None]
    return {(layout.against_model, i): change[:, i, None] for i in range(signals.n)}


def _stiffness(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    return 1.0 / np.maximum(coefficients, 1e-12)


EFFECTS = (
    Effect("transmission.elasticity", Signature(_elasticity), Plausibility(allows=positive), parameters_of=_stiffness),
    Effect("transmission.backlash", Signature(_backlash), Plausibility(allows=between(0.0, 0.3))),
)
