"""Links that weigh otherwise than the model says: they show at every joint from the base to that link."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals

LEVER = 0.15
"""Plausible shift of a link's centre of mass [m], and radius of gyration of what is added [m]."""
LIGHTEST = 0.2
"""A link counts as at least this heavy [kg] where the plausible error of its inertials is judged."""

SEVERAL = 6
"""Up to so many training recordings a payload may be in one of them alone."""
SHOWS = 0.3
"""A mass moment's own torque must be at least this share of that of the inertia which comes with it."""

FARTHEST = 0.6
"""A payload's centre of mass is no farther from the last joint than this [m]."""


def _rows(signals: Signals, layout: Layout, link: int, columns: Array) -> Columns:
    """Columns (K, n, p) at every joint that carries the link."""
    carrying = np.flatnonzero(signals.arm.carries[:, link])
    return {(layout.against_model, int(joint)): columns[:, joint] for joint in carrying}


class MassMoment(Effect):
    """An error of a link's first moment m·s; its inertia about the joint moves along with it."""

    id = "link.mass_moment"
    parameters = (Parameter("x", "kg·m"), Parameter("y", "kg·m"), Parameter("z", "kg·m"))
    rare = 0

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        """Where nothing but the inertia that comes with it would show, it is an error of the inertia, not of this."""
        own = signals.regressor[:, :, place]
        moved, along = own[..., 1:4], own[..., 4:] @ moment_to_inertia(signals.arm.inertial[place])
        shows = np.mean(moved**2, axis=(0, 1)) > SHOWS**2 * np.mean(along**2, axis=(0, 1))
        return _rows(signals, layout, place, (moved + along) * shows)

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(3, LEVER * max(signals.arm.inertial[place, 0], LIGHTEST))


class Inertia(Effect):
    """An error of a link's inertia about its joint."""

    id = "link.inertia"
    parameters = tuple(Parameter(name, "kg·m²") for name in ("xx", "xy", "xz", "yy", "yz", "zz"))

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        return _rows(signals, layout, place, signals.regressor[:, :, place, 4:])

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(6, LEVER**2 * max(signals.arm.inertial[place, 0], LIGHTEST))


class Payload(Effect):
    """A mass fixed to the tip; its centre of mass is in the last link's frame, whose origin is on that joint's axis.

    Of several training recordings one alone may have been made with it: the shape then holds that recording's number.
    """

    id = "link.payload"
    parameters = (Parameter("mass", "kg"), Parameter("x", "m"), Parameter("y", "m"), Parameter("z", "m"))
    rare = 0
    whole_arm = True
    counted = frozenset({0})

    def grid(self, signals: Sequence[Signals], place: int) -> tuple[Shape, ...]:
        several = len(signals) if 1 < len(signals) <= SEVERAL else 0
        return ((), *((float(number),) for number in range(1, several + 1)))

    def bound_to(self, shape: Shape) -> int:
        return int(shape[0]) if shape else 0

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        tip = signals.n - 1
        there = not shape or signals.number == int(shape[0])
        return _rows(signals, layout, tip, signals.regressor[:, :, tip, :4] * there)

    def spread(self, signals: Signals, place: int) -> Array:
        return np.array([20.0, 4.0, 4.0, 4.0])

    def covers(self, layout: Layout, place: int) -> tuple[tuple[str, int], ...]:
        return (("link.mass_moment", layout.n - 1),)

    def made_of(self, layout: Layout, place: int, shape: Shape) -> tuple[tuple[str, int], ...]:
        """Every link's own mass moment."""
        return tuple(("link.mass_moment", link) for link in range(layout.n))

    def plausible(self, coefficients: Array, shape: Shape) -> bool:
        mass = float(coefficients[0])
        return mass > 0.0 and float(np.linalg.norm(coefficients[1:])) < FARTHEST * mass

    def values(self, coefficients: Array, shape: Shape, beneath: Mapping[str, Array]) -> Array:
        mass = float(coefficients[0])
        return np.concatenate([[mass], coefficients[1:] / (mass if abs(mass) > 1e-6 else np.inf)])


def moment_to_inertia(inertial: Array) -> Array:
    """Change of the inertia about the joint with the first moment, to first order at the nominal centre c, (6, 3).

    I = Σ m (|r|² 1 − r rᵀ), so moving mass at c by δ adds 2 (c·mδ) 1 − (c mδᵀ + mδ cᵀ).
    """
    centre = inertial[1:4] / max(float(inertial[0]), 1e-9)
    out = np.empty((6, 3))
    for k, unit in enumerate(np.eye(3)):
        change = 2.0 * centre @ unit * np.eye(3) - np.outer(centre, unit) - np.outer(unit, centre)
        out[:, k] = change[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return out


EFFECTS: tuple[Effect, ...] = (MassMoment(), Inertia(), Payload())
