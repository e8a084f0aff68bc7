"""Links whose masses differ from the model: they show at every joint from the base to that link."""

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from gcomp.arm.inertials import SIX
from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, InverseEffect, Key, Plausibility, Ratings, SearchHints, Shape, Signature
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import ABSENT, PreparedSignals

LIGHT_KG = 1e-6
"""Least absolute mass of which a centre is taken [kg]."""


def point_mass(mass: float, moment: Array) -> Array:
    """Ten parameters of a point mass (negative if it is taken away) from its mass and first moment."""
    centre = moment / mass if abs(mass) > LIGHT_KG else np.zeros(3)
    inertia = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[mass], moment, inertia[SIX]])


def point_slopes(mass: float, moment: Array) -> Array:
    """Derivative of `point_mass` in mass and moment, (10, 4); of its first four rows alone without a mass."""
    out = np.vstack([np.eye(4), np.zeros((6, 4))])
    if abs(mass) > LIGHT_KG:
        centre = moment / mass
        out[4:, 0] = -(centre @ centre * np.eye(3) - np.outer(centre, centre))[SIX]
        out[4:, 1:] = moment_to_inertia(centre)
    return out


def mount_matrix(axis: Array, angle: float) -> Array:
    """Mass and first moment of a body that is turned about an axis (3,) by an angle, from those before, (4, 4)."""
    x, y, z = axis
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.eye(4)
    out[1:, 1:] += np.sin(angle) * hat + (1.0 - np.cos(angle)) * hat @ hat
    return out


def moment_to_inertia(centre: Array) -> Array:
    """Change of the inertia about the joint with the first moment of a body with its centre of mass there, (6, 3).

    I = Σ m (|r|² 1 − r rᵀ), so moving mass at c by δ adds 2 (c·mδ) 1 − (c mδᵀ + mδ cᵀ), to first order.
    """
    out = np.empty((6, 3))
    for k, unit in enumerate(np.eye(3)):
        change = 2.0 * centre @ unit * np.eye(3) - np.outer(centre, unit) - np.outer(unit, centre)
        out[:, k] = change[SIX]
    return out


def move_mass(inertial: Array, moment: Array) -> Array:
    """A link whose first moment is larger by `moment` (3,): its centre moves, mass and inertia about it stay, (10,)."""
    mass = max(float(inertial[0]), 1e-9)
    old, new = inertial[1:4] / mass, (inertial[1:4] + moment) / mass
    change = mass * (new @ new - old @ old) * np.eye(3) - mass * (np.outer(new, new) - np.outer(old, old))
    return np.concatenate([inertial[:1], inertial[1:4] + moment, inertial[4:] + change[SIX]])


LEVER = 0.15
"""Plausible shift of a link's centre of mass [m], and radius of gyration of added mass [m]."""
LIGHTEST = 0.2
"""Least mass of a link [kg] for judging the plausible error of its inertials."""
FEW = 4
"""With up to this number of training recordings, a payload may be in any of them."""
SHOWS = 0.3
"""A mass moment's own torque must be at least this share of the torque of the inertia that comes with it."""
TAKEN = 0.98
"""Largest share of the last link's mass that a missing body may have."""
FARTHEST = 0.6
"""Largest distance of a payload's centre of mass from the last joint [m]."""


def _rows(signals: PreparedSignals, layout: ChannelLayout, link: int, columns: Array) -> Columns:
    """Columns (K, n, p) at every joint that carries the link."""
    carrying = np.flatnonzero(signals.arm.carries[:, link])
    return {(layout.against_model, int(joint)): columns[:, joint] for joint in carrying}


def _mass_moment(signals: PreparedSignals, layout: ChannelLayout, place: int, _shape: Shape) -> Columns:
    """An error of a link's first moment m·s; its inertia about the joint changes with it.

    If only the inertia that comes with it would show, it is an error of the inertia and not of the moment.
    """
    own, inertial = signals.link_regressor(place), signals.arm.inertial[place]
    centre = inertial[1:4] / max(float(inertial[0]), 1e-9)
    moved, along = own[..., 1:4], own[..., 4:] @ moment_to_inertia(centre)
    shows = np.mean(moved**2, axis=(0, 1)) > SHOWS**2 * np.mean(along**2, axis=(0, 1))
    return _rows(signals, layout, place, (moved + along) * shows)


def _inertia(signals: PreparedSignals, layout: ChannelLayout, place: int, _shape: Shape) -> Columns:
    """An error of a link's inertia about its joint."""
    return _rows(signals, layout, place, signals.link_regressor(place)[..., 4:])


def _payload(signals: PreparedSignals, layout: ChannelLayout, _place: int, shape: Shape) -> Columns:
    """A mass fixed to the tip; its centre of mass is in the last link's frame, whose origin is on that joint's axis.

    If only some of the recordings were made with it, the shape holds their numbers as bits, the first as 1.
    """
    tip = signals.n - 1
    return _rows(signals, layout, tip, signals.link_regressor(tip)[..., :4] @ _mount(signals) * _has(signals, shape))


def _payload_slopes(signals: PreparedSignals, layout: ChannelLayout, shape: Shape, c: Array) -> Columns:
    """The same about a fitted payload: a point mass, whose inertia changes with it."""
    tip, mount = signals.n - 1, _mount(signals)
    here = mount @ c
    slopes = signals.link_regressor(tip) @ (point_slopes(float(here[0]), here[1:]) @ mount)
    return _rows(signals, layout, tip, slopes * _has(signals, shape))


def _mount(signals: PreparedSignals) -> Array:
    """Mass and first moment of the body in a recording, from those that it has in the others, (4, 4)."""
    return mount_matrix(signals.arm.axis[-1], signals.mount)


def _has(signals: PreparedSignals, shape: Shape) -> bool:
    """Whether a recording was made with the body of this shape."""
    return signals.number != ABSENT and (not shape or signals.number in recording_numbers(shape))


def recording_numbers(shape: Shape) -> tuple[int, ...]:
    """Numbers of the recordings, from 1, in a shape that holds them as bits."""
    bits = int(shape[0]) if shape else 0
    return tuple(k + 1 for k in range(bits.bit_length()) if bits >> k & 1)


def shape_of(chosen: Iterable[int]) -> Shape:
    return (float(sum(1 << (number - 1) for number in set(chosen))),)


def _recordings(signals: Sequence[PreparedSignals], _place: int) -> tuple[Shape, ...]:
    """In all recordings, in those of a group, or without groups, of a few, in any but not all."""
    groups = {name: {s.number for s in signals if name in s.groups} for s in signals for name in s.groups}
    if groups:
        return ((), *dict.fromkeys(shape_of(each) for each in groups.values()))
    known = sorted({s.number for s in signals} - {0})
    sizes = range(1, len(known)) if len(known) <= FEW else ()
    return ((), *(shape_of(each) for size in sizes for each in combinations(known, size)))


def _tip_mass_moment(layout: ChannelLayout, _place: int) -> tuple[Key, ...]:
    return (("link.mass_moment", layout.n - 1),)


def _all_mass_moments(layout: ChannelLayout, _place: int, _shape: Shape) -> tuple[Key, ...]:
    return tuple(("link.mass_moment", link) for link in range(layout.n))


def _near_the_tip(ratings: Ratings, _shape: Shape) -> tuple[Array, Array]:
    """A body at the last link; if the arm lacks it, it is no heavier than what the model has there."""
    mass = ratings.mass if ratings.own is None else abs(float(ratings.own[0]))
    high = np.array([ratings.mass, *3 * [FARTHEST * mass]])
    return np.array([-TAKEN * ratings.tip_mass, *-high[1:]]), high


def _mass_and_centre(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    mass = float(coefficients[0])
    return np.concatenate([[mass], coefficients[1:] / (mass if abs(mass) > 1e-6 else np.inf)])


def _mass(signals: PreparedSignals, link: int) -> float:
    """Mass of a link [kg], as a scale of the plausible error of its inertials."""
    return max(float(signals.arm.inertial[link, 0]), LIGHTEST)


EFFECTS = (
    InverseEffect(
        "link.mass_moment",
        Signature(_mass_moment),
        Plausibility(prior_penalty=0, prior_std=lambda signals, link: LEVER * _mass(signals, link)),
    ),
    InverseEffect(
        "link.inertia",
        Signature(_inertia),
        Plausibility(prior_std=lambda signals, link: LEVER**2 * _mass(signals, link)),
    ),
    InverseEffect(
        "link.payload",
        Signature(_payload, whole_arm=True, recordings=recording_numbers, body=True, slopes=_payload_slopes),
        Plausibility(prior_penalty=0, prior_std=np.array([20.0, 4.0, 4.0, 4.0]), bounds=_near_the_tip),
        SearchHints(
            shapes_for=_recordings, discrete=frozenset({0}), covers=_tip_mass_moment, alternatives=_all_mass_moments
        ),
        parameters_of=_mass_and_centre,
    ),
)
