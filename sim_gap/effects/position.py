"""Errors of the position sensor: at the reading, the model gives the torque of another pose than the true one.

True angle θ = gain·φ + offset + amplitude·sin(φ + phase), φ the reading. Columns are derivatives of the model torque by
finite differences, through position, velocity and acceleration together.
"""

from collections.abc import Callable, Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Plausibility, SearchHints, Shape, Signature, as_gain, between
from sim_gap.residuals.layout import Columns, Layout
from sim_gap.residuals.preprocess import Signals

EPSILON = 1e-4
PART_OF_TURN = 2.0
"""Range [rad] from which an error with a period of one turn can be separated from a gain."""
WORST_GAIN = 0.15
"""Largest scale error of a position sensor."""

Error = Callable[[Array], tuple[Array, Array, Array]]
"""Error δ(φ) of the reading per unit, δ'(φ) and δ''(φ), (K,) each."""


def _response(signals: Signals, layout: Layout, joint: int, error: Error, size: float = 0.0) -> Columns:
    """Change of the model torque per unit of the error: the secant over `size`, or the derivative if that is zero."""
    q, v, a = signals.q[:, joint], signals.v[:, joint], signals.a[:, joint]
    shift, slope, curve = error(q)
    moves = shift, slope * v, slope * a + curve * v**2
    if abs(size) > EPSILON:
        moved = [x.copy() for x in (signals.q, signals.v, signals.a)]
        for x, move in zip(moved, moves, strict=True):
            x[:, joint] += size * move
        change = (signals.arm.torque(*moved) - signals.model) / size
    else:
        slopes = signals.sensitivity(joint)
        change = slopes[0] * moves[0][:, None] + slopes[1] * moves[1][:, None] + slopes[2] * moves[2][:, None]
    return {(layout.against_model, i): change[:, i, None] for i in range(signals.n)}


def _eccentricity(signals: Signals, layout: Layout, place: int, _shape: Shape) -> Columns:
    """An eccentric encoder disc: an error with a period of one turn."""
    sine = _response(signals, layout, place, lambda q: (np.sin(q), np.cos(q), -np.sin(q)))
    cosine = _response(signals, layout, place, lambda q: (np.cos(q), -np.sin(q), -np.cos(q)))
    return {row: np.hstack([sine[row], cosine[row]]) for row in sine}


def _far_enough(signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
    """Only on a joint that turns far: on a small part of a turn the error is an offset and a gain."""
    seen = max(float(np.ptp(s.q[:, place])) for s in signals)
    return ((),) if seen > PART_OF_TURN else ()


def _amplitude_and_phase(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    return np.array([np.hypot(*coefficients), np.arctan2(coefficients[1], coefficients[0])])


def _secant(error: Error) -> Signature:
    """An error of one parameter; the shape is the size over which its secant is taken."""
    return Signature(lambda s, layout, place, shape: _response(s, layout, place, error, shape[0]))


def _small(_signals: Signals, _place: int) -> Array:
    return np.full(1, 0.2)


FROM_ZERO = SearchHints(shapes=((0.0,),), linearised_at=0)
EFFECTS = (
    Effect(
        "position.offset",
        _secant(lambda q: (np.ones_like(q), 0 * q, 0 * q)),
        Plausibility(prior_std=_small),
        FROM_ZERO,
    ),
    Effect(
        "position.gain",
        _secant(lambda q: (q, np.ones_like(q), 0 * q)),
        Plausibility(prior_std=_small, allows=between(-WORST_GAIN, WORST_GAIN)),
        FROM_ZERO,
        parameters_of=as_gain,
    ),
    Effect(
        "position.eccentricity",
        Signature(_eccentricity),
        Plausibility(prior_std=lambda _signals, _place: np.full(2, 0.1)),
        SearchHints(shapes_for=_far_enough),
        parameters_of=_amplitude_and_phase,
    ),
)
