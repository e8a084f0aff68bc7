"""Friction between motor and torque sensor: it shows on the motor side, and where there is no motor channel, in `tau`.

F(v) = (Fc + Fb·exp(−(v/vs)²) + μ·|τ|)·(1 ± ratio) + d·|v|, opposing v; τ is the transmitted torque.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

WITHIN = 0.5
"""A Stribeck velocity is below this share of the fastest usual speed."""


def dry(beneath: Mapping[str, Array]) -> float:
    """Coulomb friction in all [N·m]: what was found and what the nominal model has."""
    return float(beneath["friction.coulomb"][0] + beneath["nominal"][0])


class _Friction(Effect):
    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        """The one column of this effect, (K,)."""
        raise NotImplementedError

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return {(layout.motor_side, place): self.column(signals, place, shape)[:, None]}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(coefficients[0] >= 0.0)


class Coulomb(_Friction):
    """A constant torque against the motion."""

    id = "friction.coulomb"
    parameters = (Parameter("torque", "N·m"),)
    rare = 0
    ordinary = 0.03

    def plausible_on(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> bool:
        """Less than the nominal model has is possible; a hundredth of a newton-metre below nothing is noise."""
        return bool(coefficients[0] > -float(beneath["nominal"][0]) - 0.01)

    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        return s.direction[:, joint]


class Viscous(_Friction):
    """A torque proportional to the velocity."""

    id = "friction.viscous"
    parameters = (Parameter("damping", "N·m·s/rad"),)
    rare = 0
    ordinary = 0.02

    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        return s.v[:, joint]


class Stribeck(_Friction):
    """Friction that changes at low speed: breakaway above Coulomb's, fading as exp(−(v/vs)²).

    Real gears also have less friction at low speed than Coulomb and viscous friction say: breakaway is then negative.
    """

    id = "friction.stribeck"
    parameters = (Parameter("breakaway", "N·m"), Parameter("velocity", "rad/s"))
    needs = ("friction.coulomb",)
    shapes = ((0.03,), (0.06,), (0.12,), (0.25,), (0.5,))

    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        return s.direction[:, joint] * np.exp(-((s.v[:, joint] / shape[0]) ** 2))

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        """Velocities well within those that were seen: beyond, it is friction that varies with speed, no more."""
        fastest = float(np.quantile(np.concatenate([np.abs(s.v[:, place]) for s in signals]), 0.95))
        return tuple(shape for shape in self.shapes if shape[0] < WITHIN * fastest) or self.shapes[:1]

    def made_of(self, layout: Layout, place: int, shape: Shape) -> tuple[tuple[str, int], ...]:
        """Friction that grows with speed, or with load where speed goes with it."""
        return ("friction.viscous", place), ("friction.load", place)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return True

    def plausible_on(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> bool:
        return bool(coefficients[0] > -dry(beneath))

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([coefficients[0], shape[0]])


class Asymmetric(_Friction):
    """Friction that is (1 + ratio) times as large one way and (1 − ratio) the other; Coulomb's part of it."""

    id = "friction.asymmetric"
    parameters = (Parameter("ratio", "1"),)
    needs = ("friction.coulomb",)

    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        return np.abs(s.direction[:, joint])

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return True

    def plausible_on(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> bool:
        return bool(abs(coefficients[0]) < dry(beneath))

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return coefficients / max(abs(dry(beneath)), 1e-9)


class Load(_Friction):
    """Friction in proportion to the torque that the transmission carries."""

    id = "friction.load"
    parameters = (Parameter("coefficient", "N·m/(N·m)"),)

    def column(self, s: Signals, joint: int, shape: Shape) -> Array:
        return s.direction[:, joint] * np.abs(s.model[:, joint])


EFFECTS: tuple[Effect, ...] = (Coulomb(), Viscous(), Stribeck(), Asymmetric(), Load())
