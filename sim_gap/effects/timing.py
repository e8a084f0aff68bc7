"""Readings that come late against the position: to first order, the reading's derivative times the delay."""

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.signals import Signals


class Delay(Effect):
    """The torque sensor's reading late against the position."""

    id = "timing.delay"
    parameters = (Parameter("delay", "s"),)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        late = -np.gradient(signals.model[:, place], 1.0 / signals.rate)
        return layout.sensor_columns(place, late[:, None])


EFFECTS: tuple[Effect, ...] = (Delay(),)
