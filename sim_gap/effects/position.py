"""Errors of the position sensor: at the reading, the model gives the torque of another pose than the true one.

True angle θ = gain·φ + offset + amplitude·sin(φ + phase), φ the reading. Columns are derivatives of the model torque by
finite differences, through position, velocity and acceleration together.
"""

from collections.abc import Callable, Sequence

import numpy as np

from gcomp.arm.rigid_body import POSITION_STEP
from gcomp.arrays import Array
from sim_gap.effects.effect import (
    Beneath,
    InverseEffect,
    Moves,
    Plausibility,
    SearchHints,
    Shape,
    Signature,
)
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals

PART_OF_TURN = 2.0
"""Range [rad] from which an error with a period of one turn can be separated from a gain."""
WORST_GAIN, WORST_ECCENTRICITY = 0.15, 0.2
"""Largest scale error of a position sensor, and largest amplitude of an error with a period of one turn [rad]."""

Error = Callable[[Array], tuple[Array, ...]]
"""Errors δ(φ) of the reading φ per unit of each coefficient, then δ'(φ) of each, then δ''(φ), (K,) each."""


def responses(signals: PreparedSignals, layout: ChannelLayout, joint: int, moves: Array, size: float = 0.0) -> Columns:
    """Change of the model torque per unit of each coefficient that moves a joint, (K, p, 3) → (K, p) by row: the secant
    over `size` of the first one, or the derivative if that is no larger than a difference's step."""
    if abs(size) > POSITION_STEP:
        moved = [x.copy() for x in (signals.q, signals.v, signals.a)]
        for x, move in zip(moved, moves[:, 0].T, strict=True):
            x[:, joint] += size * move
        change = ((signals.arm.torque(*moved) - signals.bodies) / size)[..., None]
    else:
        slopes = np.stack(signals.sensitivity(joint), axis=-1)
        change = np.einsum("kid,kpd->kip", slopes, moves)
    return {(layout.against_model, i): change[:, i] for i in range(signals.n)}


def position_effect(moves: Moves, shaped: bool = False) -> Signature:
    """An effect that moves the true joint against its reading; the shape, if any, is the size of its secant."""
    return Signature(
        lambda s, layout, place, shape: responses(
            s, layout, place, moves(s, layout, place), shape[0] if shaped else 0.0
        ),
        moves=moves,
    )


def reading_moves(error: Error) -> Moves:
    """Moves for an error of the reading, a function of the reading."""

    def moves(signals: PreparedSignals, _layout: ChannelLayout, joint: int) -> Array:
        q, v, a = (x[:, joint] for x in (signals.read.q, signals.read.v, signals.read.a))
        parts = error(q)
        count = len(parts) // 3
        shift, slope, curve = (np.column_stack(parts[k * count : (k + 1) * count]) for k in range(3))
        speed = slope * v[:, None]
        return np.stack([shift, speed, slope * a[:, None] + curve * v[:, None] ** 2], axis=-1)

    return moves


def _far_enough(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
    """Only on a joint that turns far: on a small part of a turn the error is an offset and a gain."""
    seen = max(float(np.ptp(s.q[:, place])) for s in signals)
    return ((),) if seen > PART_OF_TURN else ()


def _amplitude_and_phase(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    return np.array([np.hypot(*coefficients), np.arctan2(coefficients[1], coefficients[0])])


SMALL = 0.2
"""Usual error of a position sensor [rad; 1]."""
FROM_ZERO = SearchHints(shapes=((0.0,),), linearised_at=0)
EFFECTS = (
    InverseEffect(
        "position.offset",
        position_effect(reading_moves(lambda q: (np.ones_like(q), 0 * q, 0 * q)), shaped=True),
        Plausibility(prior_std=SMALL),
        FROM_ZERO,
    ),
    InverseEffect(
        "position.gain",
        position_effect(reading_moves(lambda q: (q, np.ones_like(q), 0 * q)), shaped=True),
        Plausibility(prior_std=SMALL, bounds=(-WORST_GAIN, WORST_GAIN)),
        FROM_ZERO,
        parameters_of=lambda c, _shape, _: 1.0 + c,
    ),
    InverseEffect(
        "position.eccentricity",
        position_effect(reading_moves(lambda q: (np.sin(q), np.cos(q), np.cos(q), -np.sin(q), -np.sin(q), -np.cos(q)))),
        Plausibility(prior_std=0.5 * SMALL, bounds=(-WORST_ECCENTRICITY, WORST_ECCENTRICITY)),
        SearchHints(shapes_for=_far_enough),
        parameters_of=_amplitude_and_phase,
    ),
)
