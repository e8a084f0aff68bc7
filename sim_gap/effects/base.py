"""A base that is tilted against the model: gravity comes from another direction."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import InverseEffect, Plausibility, SearchHints, Shape, Signature
from sim_gap.model.rigid_body import POSITION_STEP
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals

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
    if angle < 1e-12:
        return np.array(gravity, float)
    axis = turn / angle
    along = axis * (axis @ gravity)
    return np.asarray(gravity * np.cos(angle) + np.cross(axis, gravity) * np.sin(angle) + along * (1 - np.cos(angle)))


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
        channel = "tau" if "tau" in s.reading else s.channels[0]
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
        "base.tilt",
        Signature(_tilt, whole_arm=True, offset=_beside),
        Plausibility(prior_std=TILT_DEVIATION),
        SearchHints(shapes_for=_starts, linearised_at=0, relinearise=lambda c, _shape: (float(c[0]), float(c[1]))),
    ),
)
