"""A position sensor that misleads: the model, put at the read position, answers for another pose than the true one.

True angle θ = gain·φ + offset + amplitude·sin(φ + phase), φ the reading. Columns are derivatives of the model torque by
finite difference, taken through position, velocity and acceleration together.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

EPSILON = 1e-4
PART_OF_TURN = 2.0
"""Range [rad] that shows whether an error comes once a turn."""
WORST_GAIN = 0.15
"""No position sensor's angles are further off than this share."""


def _response(
    signals: Signals, layout: Layout, joint: int, bend: Callable[[Array], tuple[Array, Array, Array]], size: float = 0.0
) -> Columns:
    """Change of the model torque per unit of `bend`, which gives δ(φ), δ'(φ) and δ''(φ).

    `size` is the amount over which the secant is taken; zero is the derivative.
    """
    q, v, a = signals.q[:, joint], signals.v[:, joint], signals.a[:, joint]
    shift, slope, curve = bend(q)
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


class Offset(Effect):
    """A constant angle added."""

    id = "position.offset"
    parameters = (Parameter("offset", "rad"),)
    shapes = ((0.0,),)
    secant = True

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return _response(signals, layout, place, lambda q: (np.ones_like(q), 0 * q, 0 * q), shape[0])

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(1, 0.2)


class Gain(Effect):
    """Angles scaled."""

    id = "position.gain"
    parameters = (Parameter("gain", "1"),)
    shapes = ((0.0,),)
    secant = True

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return _response(signals, layout, place, lambda q: (q, np.ones_like(q), 0 * q), shape[0])

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(1, 0.2)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(abs(coefficients[0]) < WORST_GAIN)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return 1.0 + coefficients


class Eccentricity(Effect):
    """A sensor ring out of centre: an error once a turn. On a small part of a turn it is an offset and a gain."""

    id = "position.eccentricity"
    parameters = (Parameter("amplitude", "rad"), Parameter("phase", "rad"))

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        seen = max(float(np.ptp(s.q[:, place])) for s in signals)
        return self.shapes if seen > PART_OF_TURN else ()

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        sine = _response(signals, layout, place, lambda q: (np.sin(q), np.cos(q), -np.sin(q)))
        cosine = _response(signals, layout, place, lambda q: (np.cos(q), -np.sin(q), -np.cos(q)))
        return {row: np.hstack([sine[row], cosine[row]]) for row in sine}

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(2, 0.1)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([np.hypot(*coefficients), np.arctan2(coefficients[1], coefficients[0])])


EFFECTS: tuple[Effect, ...] = (Offset(), Gain(), Eccentricity())
