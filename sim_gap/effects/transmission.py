"""Errors of the transmission between motor and torque sensor."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import CREEP, Array
from sim_gap.residuals.preprocess import Signals

ALWAYS, MOST, SLOWLY = 24, 64, 0.25
"""Ripple is searched for up to so many cycles a radian: in any case, and at most where a joint turns slowly enough."""


class Ripple(Effect):
    """Motor torque that varies with the position of the gear's teeth: amplitude·sin(cycles·q + phase)."""

    id = "transmission.ripple"
    parameters = (Parameter("amplitude", "N·m"), Parameter("cycles", "1/rad"), Parameter("phase", "rad"))

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        angle = shape[0] * signals.q[:, place]
        return {(layout.motor_side, place): np.column_stack([np.sin(angle), np.cos(angle)])}

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        """Up to ALWAYS cycles a radian, and up to MOST as far as the joint turns slowly enough to show them in the band
        during a share SLOWLY of its motion.
        """
        speed = np.concatenate([np.abs(s.v[s.moving[:, place] > 0, place]) for s in signals])
        slow = float(np.quantile(speed, SLOWLY)) if len(speed) else np.inf
        shown = 2.0 * np.pi * min(s.band for s in signals) / max(slow, CREEP)
        return tuple((float(cycles),) for cycles in range(4, int(min(max(shown, ALWAYS), MOST)) + 1, 2))

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([np.hypot(*coefficients), shape[0], np.arctan2(coefficients[1], coefficients[0])])


class Spring(Effect):
    """A spring across the joint, as a cable bundle makes: torque linear in position on the link side."""

    id = "transmission.spring"
    parameters = (Parameter("stiffness", "N·m/rad"), Parameter("rest", "rad"))

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        q = signals.q[:, place]
        return {(layout.against_model, place): np.column_stack([q, np.ones_like(q)])}

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(coefficients[0] > 0.0)

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        stiffness = float(coefficients[0])
        return np.array([stiffness, -coefficients[1] / (stiffness if abs(stiffness) > 1e-9 else np.inf)])


class Coupling(Effect):
    """The motor of this joint turns with another joint too: it feels that joint's friction and inertia.

    Motor i turns by q_i + c·q_j. Its friction follows that speed, and by the same lever c it loads joint j, so that the
    columns touch both: rotor inertia, Coulomb and viscous friction of the shared motor.
    """

    id = "transmission.coupling"
    parameters = (
        Parameter("coefficient", "1"),
        Parameter("other_joint", "joint number"),
        Parameter("inertia", "kg·m²"),
        Parameter("coulomb", "N·m"),
        Parameter("viscous", "N·m·s/rad"),
    )
    counted = frozenset({0})

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        neighbours = [place + step for step in (-1, 1) if 0 <= place + step < signals[0].n]
        return tuple((float(other + 1), lever) for other in neighbours for lever in (-1.0, -0.6, 0.6, 1.0))

    def settled(self, place: int, shape: Shape) -> tuple[int, Shape]:
        """At a lever of ±1 either joint's motor shows alike: it is then called the outer joint's, as in wrists."""
        other, lever = int(shape[0]) - 1, shape[1]
        return (other, (float(place + 1), lever)) if abs(lever) == 1.0 and other > place else (place, shape)

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        other, lever = int(shape[0]) - 1, shape[1]
        speed = signals.v[:, place] + lever * signals.v[:, other]
        push = signals.a[:, place] + lever * signals.a[:, other]
        shared = np.column_stack([push, np.clip(speed / CREEP, -1.0, 1.0), speed])
        return {(layout.motor_side, place): shared, (layout.motor_side, other): lever * shared}

    def places(self, layout: Layout) -> range:
        return range(layout.n)

    def made_of(self, layout: Layout, place: int, shape: Shape) -> tuple[tuple[str, int], ...]:
        """Each joint's own rotor and friction."""
        own = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia")
        return tuple((effect, joint) for joint in (place, int(shape[0]) - 1) for effect in own)

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        return bool(np.all(coefficients >= 0.0))

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        return np.array([shape[1], shape[0], *coefficients])


EFFECTS: tuple[Effect, ...] = (Ripple(), Spring(), Coupling())
