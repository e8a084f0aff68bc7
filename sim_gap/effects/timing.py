"""Readings that come late against the position."""

from collections.abc import Mapping

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

SHORTEST, LONGEST = 1e-3, 0.1
"""Times that count as a delay [s]."""


class Delay(Effect):
    """The torque sensor's reading late against the position."""

    id = "timing.delay"
    parameters = (Parameter("delay", "s"),)
    shapes = ((0.005,),)
    secant = True

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        torque = signals.model[:, place]
        late = np.interp(signals.t - shape[0], signals.t, torque) - torque
        return layout.sensor_columns(place, late[:, None])

    def resized(self, coefficients: Array, shape: Shape) -> Shape:
        return (float(np.clip(coefficients[0] * shape[0], SHORTEST, LONGEST)),)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(SHORTEST < coefficients[0] * shape[0] < LONGEST)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return coefficients * shape[0]


EFFECTS: tuple[Effect, ...] = (Delay(),)
