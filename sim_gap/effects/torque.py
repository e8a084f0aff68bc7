"""A joint torque sensor that misleads: in `tau` against the model, and with the other sign in motor against `tau`."""

from collections.abc import Mapping

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals


class Offset(Effect):
    """A constant added to the reading; where there is no sensor, to the motor's."""

    id = "torque.offset"
    parameters = (Parameter("offset", "N·m"),)
    rare = 0
    ordinary = 0.02

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, np.ones((len(signals.t), 1)))


class _Sensor(Effect):
    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.sensor else 0)


class Gain(_Sensor):
    """The reading scaled."""

    id = "torque.gain"
    parameters = (Parameter("gain", "1"),)
    rare = 0
    ordinary = 0.002

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, signals.model[:, place, None])

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(-0.5 < coefficients[0] < 1.0)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return 1.0 + coefficients


class Drift(_Sensor):
    """An offset that grows with time."""

    id = "torque.drift"
    parameters = (Parameter("rate", "N·m/s"),)
    needs = ("torque.offset",)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return layout.sensor_columns(place, signals.t[:, None])


EFFECTS: tuple[Effect, ...] = (Offset(), Gain(), Drift())
