"""Links whose masses differ from the model, at every joint from the base to that link; a base that is tilted."""

from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from gcomp.arm.inertials import LIGHT_KG, moment_to_inertia, point_slopes
from gcomp.arm.rigid_body import POSITION_STEP, turned
from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, InverseEffect, Key, Plausibility, Ratings, SearchHints, Shape, Signature
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import ABSENT, PreparedSignals


def mount_matrix(axis: Array, angle: float) -> Array:
    """Mass and first moment of a body that is turned about an axis (3,) by an angle, from those before, (4, 4)."""
    out = np.eye(4)
    out[1:, 1:] = turned(np.eye(3), axis, angle)
    return out


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


def link_rows(signals: PreparedSignals, layout: ChannelLayout, link: int, columns: Array) -> Columns:
    """Columns (K, n, p) at every joint that carries the link."""
    carrying = np.flatnonzero(signals.arm.carries[:, link])
    return {(layout.against_model, int(joint)): columns[:, joint] for joint in carrying}


def _mass_moment(signals: PreparedSignals, layout: ChannelLayout, place: int, _shape: Shape) -> Columns:
    """An error of a link's first moment m·s, and with it of its inertia; where that alone would show, none of the
    moment."""
    own, inertial = signals.link_regressor(place), signals.arm.inertial[place]
    centre = inertial[1:4] / max(float(inertial[0]), 1e-9)
    moved, along = own[..., 1:4], own[..., 4:] @ moment_to_inertia(centre)
    shows = np.mean(moved**2, axis=(0, 1)) > SHOWS**2 * np.mean(along**2, axis=(0, 1))
    return link_rows(signals, layout, place, (moved + along) * shows)


def _inertia(signals: PreparedSignals, layout: ChannelLayout, place: int, _shape: Shape) -> Columns:
    """An error of a link's inertia about its joint."""
    return link_rows(signals, layout, place, signals.link_regressor(place)[..., 4:])


def _payload(signals: PreparedSignals, layout: ChannelLayout, _place: int, shape: Shape) -> Columns:
    """A mass fixed to the tip; its centre of mass is in the last link's frame, whose origin is on that joint's axis.

    If only some of the recordings were made with it, the shape holds their numbers as bits, the first as 1.
    """
    tip = signals.n - 1
    return link_rows(
        signals, layout, tip, signals.link_regressor(tip)[..., :4] @ _mount(signals) * _has(signals, shape)
    )


def _payload_slopes(signals: PreparedSignals, layout: ChannelLayout, shape: Shape, c: Array) -> Columns:
    """The same about a fitted payload: a point mass, whose inertia changes with it."""
    tip, mount = signals.n - 1, _mount(signals)
    here = mount @ c
    slopes = signals.link_regressor(tip) @ (point_slopes(float(here[0]), here[1:]) @ mount)
    return link_rows(signals, layout, tip, slopes * _has(signals, shape))


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


def _all_mass_moments(layout: ChannelLayout, _place: int, _shape: Shape) -> tuple[Key, ...]:
    return tuple(("link.mass_moment", link) for link in range(layout.n))


def _near_the_tip(ratings: Ratings, _shape: Shape) -> tuple[Array, Array]:
    """A body at the last link; if the arm lacks it, it is no heavier than what the model has there."""
    mass = ratings.mass if ratings.own is None else abs(float(ratings.own[0]))
    high = np.array([ratings.mass, *3 * [FARTHEST * mass]])
    return np.array([-TAKEN * ratings.tip_mass, *-high[1:]]), high


def _mass_and_centre(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    mass = float(coefficients[0])
    return np.concatenate([[mass], coefficients[1:] / (mass if abs(mass) > LIGHT_KG else np.inf)])


def _mass(signals: PreparedSignals, link: int) -> float:
    """Mass of a link [kg], as a scale of the plausible error of its inertials."""
    return max(float(signals.arm.inertial[link, 0]), LIGHTEST)


# ---- a base that is tilted against the model: gravity comes from another direction

TILT_DEVIATION = 1.0
"""Prior standard deviation of an angle of the tilt [rad]: a base may stand on a wall."""
LARGE = 0.3
"""Tilt from which the search also starts [rad]."""


def axes_across(gravity: Array) -> Array:
    """The two base axes closest to perpendicular to gravity, (2, 3)."""
    order = np.sort(np.argsort(np.abs(gravity), kind="stable")[:2])
    return np.eye(3)[order]


def tilt_gravity(gravity: Array, angles: Array) -> Array:
    """Gravity in the frame of a base that is rotated by a rotation vector about two axes across gravity, (3,).

    The vector has the two angles [rad] as its components; gravity rotates the other way (Rodrigues).
    """
    turn = -np.asarray(angles, float) @ axes_across(gravity)
    angle = float(np.linalg.norm(turn))
    return np.asarray(turned(np.eye(3), turn / max(angle, 1e-12), angle) @ gravity)


def _slopes(gravity: Array, angles: Array) -> Array:
    """Derivative of `tilt_gravity` in the two angles, (3, 2)."""
    steps = POSITION_STEP * np.eye(2)
    return np.stack([tilt_gravity(gravity, angles + d) - tilt_gravity(gravity, angles - d) for d in steps], axis=-1) / (
        2 * POSITION_STEP
    )


def _tilt(signals: PreparedSignals, layout: ChannelLayout, _place: int, shape: Shape) -> Columns:
    """The base rotated about two axes across gravity (its x and y if gravity is along z), linearised at `shape`."""
    columns = np.asarray(signals.gravity_columns @ _slopes(signals.read.arm.gravity, np.array(shape or (0.0, 0.0))))
    return {(layout.against_model, joint): columns[:, joint] for joint in range(signals.n)}


def _beside(signals: PreparedSignals, layout: ChannelLayout, shape: Shape) -> Columns:
    """Part of a large tilt that its columns lack."""
    nominal, angles = signals.read.arm.gravity, np.array(shape or (0.0, 0.0))
    rest = tilt_gravity(nominal, angles) - nominal - _slopes(nominal, angles) @ angles
    return {(layout.against_model, joint): signals.gravity_columns[:, joint] @ rest for joint in range(signals.n)}


def _starts(signals: Sequence[PreparedSignals], _place: int) -> tuple[Shape, ...]:
    """No tilt, and the direction that a free fit of gravity finds, if that is far from the model's."""
    nominal = signals[0].arm.gravity
    gram, side = 1e-9 * np.eye(3), np.zeros(3)
    for s in signals:
        channel = "tau" if "tau" in s.reading else next(iter(s.reading))
        for joint in range(s.n):
            moved = np.column_stack([np.ones(len(s.t)), s.direction[:, joint], s.v[:, joint]])
            columns = np.column_stack([s.gravity_columns[:, joint], s.reading[channel][:, joint] - s.model[:, joint]])
            x = columns - moved @ np.linalg.lstsq(moved, columns, rcond=None)[0]
            gram, side = gram + x[:, :3].T @ x[:, :3], side + x[:, :3].T @ x[:, 3]
    found = nominal + np.linalg.lstsq(gram, side, rcond=1e-6)[0]
    angles = angles_of(nominal, found)
    flat: Shape = (0.0, 0.0)
    return (flat, (float(angles[0]), float(angles[1]))) if np.linalg.norm(angles) > LARGE else (flat,)


def angles_of(nominal: Array, found: Array) -> Array:
    """The two angles at which `tilt_gravity` turns the direction of gravity to that of `found` [rad], (2,)."""
    length = float(np.linalg.norm(nominal) * np.linalg.norm(found))
    if length < 1e-12:
        return np.zeros(2)
    cross, cosine = np.cross(found, nominal) / length, float(np.clip(nominal @ found / length, -1.0, 1.0))
    axis = axes_across(nominal) @ cross
    size = float(np.linalg.norm(axis))
    return np.asarray(np.arccos(cosine) * (axis / size if size > 1e-9 else np.array([1.0, 0.0])))


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
            shapes_for=_recordings,
            discrete=frozenset({0}),
            covers=lambda layout, _: (("link.mass_moment", layout.n - 1),),
            alternatives=_all_mass_moments,
        ),
        parameters_of=_mass_and_centre,
    ),
    InverseEffect(
        "base.tilt",
        Signature(_tilt, whole_arm=True, offset=_beside),
        Plausibility(prior_std=TILT_DEVIATION),
        SearchHints(shapes_for=_starts, linearised_at=0, relinearise=lambda c, _shape: (float(c[0]), float(c[1]))),
    ),
)
