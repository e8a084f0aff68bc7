"""Errors of motor and drive: the motor's torque is not what the drive says."""

from collections.abc import Mapping

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals


class Gain(Effect):
    """Torque made per torque reported: the error of the torque constant."""

    id = "actuator.gain"
    parameters = (Parameter("gain", "1"),)
    ordinary = 0.002

    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.motor else 0)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        """The whole motor torque that the nominal model asks for: rotor and friction that it knows are scaled too."""
        return {(layout.motor_side, place): signals.motor_model[:, place, None]}

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(1, 0.5)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(-0.5 < coefficients[0] < 1.0)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return 1.0 / (1.0 + coefficients)


class RotorInertia(Effect):
    """The motor's rotor, seen at the joint."""

    id = "actuator.rotor_inertia"
    parameters = (Parameter("inertia", "kg·m²"),)
    rare = 0

    def places(self, layout: Layout) -> range:
        return range(layout.n if layout.motor else 0)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.motor_side, place): signals.a[:, place, None]}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(coefficients[0] >= 0.0)


EFFECTS: tuple[Effect, ...] = (Gain(), RotorInertia())
