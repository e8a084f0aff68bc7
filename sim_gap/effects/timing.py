"""Readings that come late against the position: to first order, the reading's derivative times the delay."""

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.rigid import Array
from sim_gap.signals import Signals

LONGEST = 0.1
"""Longest delay to which its first-order form applies [s]."""


class Delay(Effect):
    """The torque sensor's reading late against the position."""

    id = "timing.delay"
    parameters = (Parameter("delay", "s"),)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        late = -np.gradient(signals.model[:, place], 1.0 / signals.rate)
        return layout.sensor_columns(place, late[:, None])

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(0.0 < coefficients[0] < LONGEST)


EFFECTS: tuple[Effect, ...] = (Delay(),)
