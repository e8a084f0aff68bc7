"""Links whose masses differ from the model: they show at every joint from the base to that link."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Key, Plausibility, SearchHints, Shape, Signature
from sim_gap.residuals.layout import Columns, Layout
from sim_gap.residuals.preprocess import Signals

LEVER = 0.15
"""Plausible shift of a link's centre of mass [m], and radius of gyration of added mass [m]."""
LIGHTEST = 0.2
"""Least mass of a link [kg] for judging the plausible error of its inertials."""
SEVERAL = 6
"""With up to this number of training recordings, a payload may be in one of them alone."""
SHOWS = 0.3
"""A mass moment's own torque must be at least this share of the torque of the inertia that comes with it."""
FARTHEST = 0.6
"""Largest distance of a payload's centre of mass from the last joint [m]."""


def _rows(signals: Signals, layout: Layout, link: int, columns: Array) -> Columns:
    """Columns (K, n, p) at every joint that carries the link."""
    carrying = np.flatnonzero(signals.arm.carries[:, link])
    return {(layout.against_model, int(joint)): columns[:, joint] for joint in carrying}


def _mass_moment(signals: Signals, layout: Layout, place: int, _shape: Shape) -> Columns:
    """An error of a link's first moment m·s; its inertia about the joint changes with it.

    If only the inertia that comes with it would show, it is an error of the inertia and not of the moment.
    """
    own = signals.regressor[:, :, place]
    moved, along = own[..., 1:4], own[..., 4:] @ moment_to_inertia(signals.arm.inertial[place])
    shows = np.mean(moved**2, axis=(0, 1)) > SHOWS**2 * np.mean(along**2, axis=(0, 1))
    return _rows(signals, layout, place, (moved + along) * shows)


def _inertia(signals: Signals, layout: Layout, place: int, _shape: Shape) -> Columns:
    """An error of a link's inertia about its joint."""
    return _rows(signals, layout, place, signals.regressor[:, :, place, 4:])


def _payload(signals: Signals, layout: Layout, _place: int, shape: Shape) -> Columns:
    """A mass fixed to the tip; its centre of mass is in the last link's frame, whose origin is on that joint's axis.

    If only one of several training recordings was made with it, the shape holds that recording's number.
    """
    tip = signals.n - 1
    present = not shape or signals.number == int(shape[0])
    return _rows(signals, layout, tip, signals.regressor[:, :, tip, :4] * present)


def _recordings(signals: Sequence[Signals], _place: int) -> tuple[Shape, ...]:
    several = len(signals) if 1 < len(signals) <= SEVERAL else 0
    return ((), *((float(number),) for number in range(1, several + 1)))


def _tip_mass_moment(layout: Layout, _place: int) -> tuple[Key, ...]:
    return (("link.mass_moment", layout.n - 1),)


def _all_mass_moments(layout: Layout, _place: int, _shape: Shape) -> tuple[Key, ...]:
    return tuple(("link.mass_moment", link) for link in range(layout.n))


def _near_the_tip(coefficients: Array, _shape: Shape, _beneath: Beneath) -> bool:
    mass = float(coefficients[0])
    return mass > 0.0 and float(np.linalg.norm(coefficients[1:])) < FARTHEST * mass


def _mass_and_centre(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    mass = float(coefficients[0])
    return np.concatenate([[mass], coefficients[1:] / (mass if abs(mass) > 1e-6 else np.inf)])


def _mass(signals: Signals, link: int) -> float:
    """Mass of a link [kg], as a scale of the plausible error of its inertials."""
    return max(float(signals.arm.inertial[link, 0]), LIGHTEST)


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


EFFECTS = (
    Effect(
        "link.mass_moment",
        Signature(_mass_moment),
        Plausibility(prior_penalty=0, prior_std=lambda signals, link: np.full(3, LEVER * _mass(signals, link))),
    ),
    Effect(
        "link.inertia",
        Signature(_inertia),
        Plausibility(prior_std=lambda signals, link: np.full(6, LEVER**2 * _mass(signals, link))),
    ),
    Effect(
        "link.payload",
        Signature(_payload, whole_arm=True, recording=lambda shape: int(shape[0]) if shape else 0),
        Plausibility(
            prior_penalty=0, prior_std=lambda _signals, _place: np.array([20.0, 4.0, 4.0, 4.0]), allows=_near_the_tip
        ),
        SearchHints(
            shapes_for=_recordings, discrete=frozenset({0}), covers=_tip_mass_moment, alternatives=_all_mass_moments
        ),
        parameters_of=_mass_and_centre,
    ),
)
