"""A base that is tilted against the model: gravity comes from another direction."""

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Effect, Plausibility, Shape, Signature
from sim_gap.residuals.layout import Columns, Layout
from sim_gap.residuals.preprocess import Signals


def _tilt(signals: Signals, layout: Layout, _place: int, _shape: Shape) -> Columns:
    """The base rotated by small angles about two axes across gravity (its x and y if gravity is along z)."""
    gravity = signals.arm.gravity
    turned = np.stack([-np.cross(axis, gravity) for axis in across(gravity)], axis=-1)
    columns = signals.gravity_columns @ turned
    return {(layout.against_model, joint): columns[:, joint] for joint in range(signals.n)}


def across(gravity: Array) -> Array:
    """The two base axes closest to perpendicular to gravity, (2, 3)."""
    order = np.sort(np.argsort(np.abs(gravity), kind="stable")[:2])
    return np.eye(3)[order]


EFFECTS = (
    Effect(
        "base.tilt",
        Signature(_tilt, whole_arm=True),
        Plausibility(prior_std=lambda _signals, _place: np.full(2, 0.3)),
    ),
)
