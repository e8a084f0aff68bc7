"""Friction between motor and torque sensor: it shows on the motor side, and without a motor channel, in `tau`.

What rubs behind the sensor, on the link side, shows in `tau` against the model.

F(v) = (Fc + Fb·exp(−(v/vs)²) + μ·|τ|)·(1 ± ratio) + d·|v|, opposing v; τ is the transmitted torque.
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import (
    Beneath,
    InverseEffect,
    Key,
    Plausibility,
    Ratings,
    SearchHints,
    Shape,
    Signature,
)
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals

COULOMB = ("friction.coulomb",)
SLOWEST = 0.05
"""Usual speed of a joint from which dry friction in the model may be taken for viscous [rad/s]."""
VELOCITIES = (0.03, 0.06, 0.12, 0.25, 0.5)
"""Stribeck velocities that the search starts with [rad/s]."""
SELF_LOCKING = 0.5
"""Friction over transmitted torque from which a gear is self-locking: it cannot be driven from its output, as the
weight of an arm that swings free drives it. Harmonic and cycloidal gears have 0.05 to 0.3, worm gears up to this."""
WITHIN = 0.5
"""A Stribeck velocity is below this share of the fastest usual speed."""


def _dry_above_nominal(ratings: Ratings, _shape: Shape) -> tuple[float, float]:
    """The arm may have less friction than the model, of both kinds: one alone stands for both at the usual speed."""
    return -ratings.friction - ratings.damping * ratings.speed, ratings.torque


def _viscous_above_nominal(ratings: Ratings, _shape: Shape) -> tuple[float, float]:
    speed = max(ratings.speed, SLOWEST)
    return -ratings.damping - ratings.friction / speed, ratings.torque / speed


def _stribeck(s: PreparedSignals, joint: int, shape: Shape) -> Array:
    """Breakaway in excess of Coulomb friction, decaying as exp(−(v/vs)²)."""
    return np.asarray(s.direction[:, joint] * np.exp(-((s.v[:, joint] / shape[0]) ** 2)))


def _bearing(s: PreparedSignals, layout: ChannelLayout, joint: int, _shape: Shape) -> Columns:
    """Dry and viscous friction on the link side of a torque sensor."""
    return {(layout.against_model, joint): np.column_stack([s.direction[:, joint], s.v[:, joint]])}


def _bearing_bounds(ratings: Ratings, _shape: Shape) -> tuple[float, Array]:
    return 0.0, np.array([ratings.torque, ratings.torque / max(ratings.speed, SLOWEST)])


def _velocities(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
    """Velocities well within the recorded ones: beyond, the effect is friction that varies with speed."""
    fastest = float(np.quantile(np.concatenate([np.abs(s.v[:, place]) for s in signals]), 0.95))
    shapes = tuple((velocity,) for velocity in VELOCITIES)
    return tuple(shape for shape in shapes if shape[0] < WITHIN * fastest) or shapes[:1]


def _viscous_or_load(_layout: ChannelLayout, place: int, _shape: Shape) -> tuple[Key, ...]:
    """Friction that grows with speed, or with the load if that correlates with speed."""
    return ("friction.viscous", place), ("friction.load", place)


def _ratio(coefficients: Array, _shape: Shape, beneath: Beneath) -> Array:
    """Friction is (1 + ratio) times as large in one direction and (1 − ratio) in the other; of its Coulomb part."""
    dry = float(beneath["friction.coulomb"][0] + beneath["nominal"][0])
    return coefficients / max(abs(dry), 1e-9)


EFFECTS = (
    InverseEffect(
        "friction.coulomb",
        Signature.at_motor(lambda s, joint, _: s.direction[:, joint], of_motion=True),
        Plausibility(every_joint=True, background_std=0.03, background_nm=True, bounds=_dry_above_nominal),
    ),
    InverseEffect(
        "friction.viscous",
        Signature.at_motor(lambda s, joint, _: s.v[:, joint], of_motion=True),
        Plausibility(every_joint=True, background_std=0.02, background_nm=True, bounds=_viscous_above_nominal),
    ),
    InverseEffect(
        "friction.stribeck",
        Signature.at_motor(_stribeck, of_motion=True),
        Plausibility(bounds=lambda ratings, _shape: (0.0, ratings.torque)),
        SearchHints(shapes_for=_velocities, alternatives=_viscous_or_load),
        needs=COULOMB,
        parameters_of=lambda c, shape, _: [c[0], shape[0]],
    ),
    InverseEffect(
        "friction.asymmetric",
        Signature.at_motor(lambda s, joint, _: np.abs(s.direction[:, joint]), of_motion=True),
        Plausibility(bounds=lambda ratings, _shape: (-ratings.dry, ratings.dry)),
        needs=COULOMB,
        parameters_of=_ratio,
    ),
    InverseEffect(  # with a sensor alone, or a motor alone, it is not to be told from the friction before the sensor
        "friction.bearing",
        Signature(_bearing, ("sensor", "motor")),
        Plausibility(prior_penalty=0, background_std=0.02, background_nm=True, bounds=_bearing_bounds),
    ),
    InverseEffect(
        "friction.load",
        Signature.at_motor(lambda s, joint, _: s.direction[:, joint] * np.abs(s.model[:, joint])),
        Plausibility(bounds=(0.0, SELF_LOCKING)),
    ),
)
