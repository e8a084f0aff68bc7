"""How well the nominal model explains a torque channel, joint by joint, under physical signs.

A reading is fitted by the model's torque and the joint's own friction and rotor, each with a coefficient that cannot be
negative. A wrong sign, order or unit leaves most of the reading unexplained; wrong masses, friction or gains do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from gcomp.arrays import Array, Mask
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import PreparedSignals

ROWS = 1500
"""Rows that the fit looks at."""
FEW = 5
"""One in this many of them is enough to see that a hypothesis is wrong."""
SCREENED = 0.3
"""Share of the fall from which something is certain that it must reach on few rows to be looked at."""
TURNING = 0.02
"""Speed from which friction has its full sign [rad/s]."""
MOVING_SHARE = 0.3
"""Share of rows in motion from which the sign of friction counts."""
MOVING_LEAST = 0.1
"""Share of rows in motion from which a motor's torque at rest is left out."""
FLOOR = 0.02
"""Share of a reading's variance below which what is left does not count: noise, and effects of every arm."""
STRONG_SHARE, STRONG_CORRELATION = 0.2, 0.8
"""A joint is strong if the model's own part is this share of the reading, and correlates with it so."""


@dataclass(frozen=True, eq=False)
class ChannelMotion:
    """Positions, velocities, accelerations and one torque channel on common rows, (K, n) each."""

    q: Array
    v: Array
    a: Array
    reading: Array
    channel: str

    @property
    def direction(self) -> Array:
        """Sign of the velocity, rounded off around zero (K, n)."""
        return np.clip(self.v / TURNING, -1.0, 1.0)


@dataclass(frozen=True, eq=False)
class RigidFit:
    """Fit of every joint, (n,) each."""

    explained: Array
    """Share of the reading's variance that the fit explains."""
    scale: Array
    """Coefficient of the model's torque; 1 for a perfect model in the same unit."""
    correlation: Array
    """Partial correlation of reading and model, given the other columns: negative for a wrong sign."""
    own_share: Array
    """Standard deviation of the model's own part, over that of the reading, at scale 1."""
    friction: Array
    """Direction-dependent torque [N·m], of either sign; NaN for a joint that hardly moves."""
    spread: Array
    """Standard deviation of the reading [N·m]."""

    @property
    def cost(self) -> Array:
        """Logarithm of what is left, (n,)."""
        return np.asarray(np.log(1.0 - np.clip(self.explained, 0.0, 1.0) + FLOOR))

    @property
    def strong(self) -> Mask:
        share = self.own_share * np.maximum(self.scale, 1.0)
        return np.asarray((share > STRONG_SHARE) & (np.abs(self.correlation) > STRONG_CORRELATION))


def motion_of(s: PreparedSignals, channel: str) -> ChannelMotion:
    """The compared rows of a recording, thinned to about `ROWS`."""
    thin = slice(None, None, max(1, len(s.filtered(s.t)) // ROWS))
    q, v, a, reading = (s.filtered(x)[thin] for x in (s.q, s.v, s.a, s.reading[channel]))
    return ChannelMotion(q, v, a, reading, channel)


def fit_rigid(arm: RigidArm, motion: ChannelMotion, springs: bool = False) -> RigidFit:
    """Fit the reading of every joint by the model's torque at the motion; with `springs`, of either sign, too."""
    return fit_model(arm.carried(motion.q, motion.v, motion.a), motion, springs)


def fit_model(model: Array, motion: ChannelMotion, springs: bool = False) -> RigidFit:
    """Fit the reading of every joint by a model torque (K, n); with `springs`, of either sign, too."""
    return fit_models([(model, motion)], springs)[0]


def fit_models(pairs: Sequence[tuple[Array, ChannelMotion]], springs: bool = False) -> list[RigidFit]:
    """`fit_model` of several model torques and motions of one arm at once."""
    moving = np.array([np.mean(np.abs(motion.v) > TURNING, axis=0) for _, motion in pairs])
    sensed = np.array([[motion.channel == "tau"] for _, motion in pairs])
    grams = np.array([_covariances(model, motion, springs) for model, motion in pairs])
    fits = _joints(grams.reshape(-1, *grams.shape[2:]), (sensed | (moving < MOVING_SHARE)).ravel())
    found = [RigidFit(*values.T) for values in fits.reshape(*moving.shape, -1)]
    return [
        replace(fit, friction=np.where(share < MOVING_SHARE, np.nan, fit.friction))
        for fit, share in zip(found, moving, strict=True)
    ]


def least_costs(pairs: Sequence[tuple[Array, ChannelMotion]]) -> Array:
    """Least summed cost of model torques and motions of one arm by least squares, whatever the signs, (M,)."""
    grams = np.array([_covariances(model, motion, False) for model, motion in pairs])
    grams /= np.maximum(grams[..., -1:, -1:], 1e-18)
    columns, reading = grams[..., :4, :4], grams[..., :4, -1:]
    size = np.sqrt(np.maximum(np.diagonal(columns, axis1=-2, axis2=-1), 1e-12))
    columns, reading = columns / size[..., None] / size[..., None, :], reading / size[..., None]
    explained = (reading * _solved(columns, reading)).sum((-2, -1))
    return np.asarray(np.log(1.0 - np.clip(explained, 0.0, 1.0) + FLOOR).sum(-1))


def _covariances(model: Array, motion: ChannelMotion, springs: bool) -> Array:
    """Of model torque, direction, velocity, acceleration, position and reading of every joint, (n, 6, 6)."""
    turned = motion.q if springs else 0.0 * motion.q
    columns = np.stack([model, motion.direction, motion.v, motion.a, turned, motion.reading]).transpose(2, 0, 1)
    telling = _telling(motion).T[:, None]
    weight = telling / telling.sum(-1, keepdims=True)
    columns = columns - (columns * weight).sum(-1, keepdims=True)
    return np.asarray((columns * weight) @ columns.transpose(0, 2, 1))


def _telling(motion: ChannelMotion) -> Mask:
    """Rows that are fitted at each joint, (K, n): friction at rest takes any value, which a motor has to hold.

    All rows of a sensor on the link, and of a joint that hardly moves.
    """
    moving = np.abs(motion.v) > TURNING
    return np.asarray(moving | (motion.channel == "tau") | (moving.mean(0) < MOVING_LEAST))


def fit_beside_slow_torques(arm: RigidArm, motion: ChannelMotion, fit: RigidFit) -> RigidFit:
    """The fit with the friction that remains beside a drift of the reading and a spring across the joint.

    In a motion with few reversals a torque that grows with time or position varies with the direction, too.
    """
    model, friction = arm.carried(motion.q, motion.v, motion.a), fit.friction.copy()
    direction, time = motion.direction, np.linspace(-1.0, 1.0, len(model))
    for j in np.flatnonzero(np.isfinite(friction)):
        own = (model[:, j], motion.v[:, j], motion.a[:, j], motion.q[:, j])
        columns = np.stack([direction[:, j], *own, np.ones_like(time), time, time**2], axis=1)
        friction[j] = np.linalg.lstsq(columns, motion.reading[:, j], rcond=None)[0][0]
    return replace(fit, friction=friction)


def _joints(grams: Array, unsigned: Mask) -> Array:
    """The fields of `RigidFit` of J joints from their `_covariances` (J, 6, 6), (J, 6).

    A sensor on the link feels no gear, and a joint at rest no friction (`unsigned`): then the sign of those columns
    says nothing, and they have both.
    Least squares of any sign are the fit where their signs are right, as they mostly are.
    """
    size = np.sqrt(np.diagonal(grams, axis1=1, axis2=2))
    spread = size[:, -1]
    out = np.column_stack([np.tile([1.0, 1.0, 0.0, 0.0, np.nan], (len(grams), 1)), spread])
    there = np.flatnonzero((spread >= 1e-9) & (size[:, 1] >= 1e-6))  # something is read, and the joint does not rest
    units = np.where(size > 1e-9, size, 1.0)
    units[:, 4] = np.where(size[:, 4] > 1e-6, size[:, 4], np.inf)
    scaled = (grams / units[:, None] / units[:, :, None])[there]
    correlation, own = _partial(scaled)
    free = _solved(scaled[:, :4, :4], scaled[:, :4, -1:])[:, 1, 0]
    best = _solved(scaled[:, :5, :5], scaled[:, :5, -1:])[..., 0]
    out[there, 0] = (best * scaled[:, :5, -1]).sum(-1)
    out[there, 1] = best[:, 0] * spread[there] / units[there, 0]
    physical = (best[:, 0] >= 0.0) & (unsigned[there] | np.all(best[:, 1:4] >= 0.0, axis=1))
    for k in np.flatnonzero(~physical).tolist():
        j, both = there[k], (1.0, -1.0)
        signs = [(1.0,), *[both if unsigned[j] else (1.0,)] * 3, *([both] if np.isfinite(units[j, 4]) else [])]
        coefficient, explained = _positive_fit(scaled[k], signs)
        out[j, :2] = explained, coefficient * spread[j] / units[j, 0]
    out[there, 2], out[there, 3] = correlation, own * units[there, 0] / spread[there]
    out[there, 4] = free * spread[there] / units[there, 1]
    return out


def _partial(grams: Array) -> tuple[Array, Array]:
    """Correlation of the reading with the model given friction and rotor, and the standard deviation of the model's own
    part, (J,) each."""
    through = _solved(grams[:, 1:4, 1:4], grams[:, 1:4][:, :, [0, -1]])
    left = grams[:, [[0], [-1]], [0, -1]] - grams[:, [0, -1], 1:4] @ through
    own, rest = np.sqrt(np.maximum(np.diagonal(left, axis1=1, axis2=2), 0.0)).T
    return left[:, 0, 1] / (own * rest + 1e-12), own


def _solved(grams: Array, sides: Array) -> Array:
    """Least squares of least norm from covariances (J, p, p) and (J, p, m), (J, p, m)."""
    return np.asarray(np.linalg.pinv(grams, rcond=1e-12, hermitian=True) @ sides)


def _positive_fit(gram: Array, signs: Sequence[tuple[float, ...]]) -> tuple[float, float]:
    """First coefficient of a fit with none negative, of the columns with each of their signs, and the share of the
    reading's variance explained.

    By a root of the covariance, which has the same least squares as the columns have.
    """
    values, vectors = np.linalg.eigh(gram)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    chosen = np.stack([sign * root[:, k] for k, both in enumerate(signs) for sign in both], axis=1)
    coefficients, rest = nnls(chosen, root[:, -1])
    return float(coefficients[0]), float(1.0 - rest**2)


def rows_of(motion: ChannelMotion, rows: slice) -> ChannelMotion:
    q, v, a, reading = (x[rows] for x in (motion.q, motion.v, motion.a, motion.reading))
    return ChannelMotion(q, v, a, reading, motion.channel)
