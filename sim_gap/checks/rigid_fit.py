"""How well the nominal model explains a torque channel, joint by joint, under physical signs.

A reading is fitted by the model's torque and the joint's own friction and rotor, each with a coefficient that cannot be
negative. A wrong sign, order or unit leaves most of the reading unexplained; wrong masses, friction or gains do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gcomp.arrays import Array
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import Signals

ROWS = 1500
"""Rows that the fit looks at."""
FEW = 5
"""One in this many of them is enough to see that a hypothesis is wrong."""
TURNING = 0.02
"""Speed from which friction has its full sign [rad/s]."""
MOVING_SHARE = 0.3
"""Share of rows in motion from which the sign of friction counts."""
FLOOR = 0.02
"""Share of a reading's variance below which what is left does not count: noise, and effects of every arm."""
MOUNTED = 0.1
"""Share of the readings' variance that may be left (geometric mean) for gravity along another axis to count."""
UPSIDE_DOWN = 0.98
"""Cosine from which gravity is nearly opposite: then a turned sign of all torques is as good, and far more common."""
STRONG_SHARE, STRONG_CORRELATION = 0.2, 0.8
"""A joint is strong if the model's own part is this share of the reading, and correlates with it so."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions, velocities, accelerations and one torque channel on common rows, (K, n) each."""

    q: Array
    v: Array
    a: Array
    reading: Array
    channel: str


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
    def strong(self) -> NDArray[np.bool_]:
        """Whether the model says much of a joint's reading, (n,)."""
        share = self.own_share * np.maximum(self.scale, 1.0)
        return np.asarray((share > STRONG_SHARE) & (np.abs(self.correlation) > STRONG_CORRELATION))


def motion_of(s: Signals, channel: str) -> Motion:
    """The compared rows of a recording, thinned to about `ROWS`."""
    thin = slice(None, None, max(1, len(s.filtered(s.t)) // ROWS))
    q, v, a, reading = (s.filtered(x)[thin] for x in (s.q, s.v, s.a, s.reading[channel]))
    return Motion(q, v, a, reading, channel)


def fit_rigid(arm: RigidArm, motion: Motion, springs: bool = False) -> RigidFit:
    """Fit the reading of every joint by the model's torque at the motion; with `springs`, of either sign, too."""
    return fit_model(arm.torque(motion.q, motion.v, motion.a), motion, springs)


def fit_model(model: Array, motion: Motion, springs: bool = False) -> RigidFit:
    """Fit the reading of every joint by a model torque (K, n); with `springs`, of either sign, too."""
    fits = [_joint(model[:, j], motion, j, springs) for j in range(model.shape[1])]
    return RigidFit(*(np.array(values) for values in zip(*fits, strict=True)))


def as_mounted(arm: RigidArm, motion: Motion) -> RigidArm:
    """The arm with gravity along the axis that fits best, if that is better than the nominal one.

    A tilted base is an effect of the arm, which the diagnosis finds; no fault of the data must be seen in it.
    """
    still = np.zeros_like(motion.q)
    inertia = arm.torque(motion.q, motion.v, motion.a, np.zeros(3))
    columns = np.stack([arm.torque(motion.q, still, still, axis) for axis in np.eye(3)], axis=-1)
    weight = 1.0 / (motion.reading.std(0) + 1e-9)
    left = ((motion.reading - inertia) * weight).ravel()
    gravity = np.linalg.lstsq((columns * weight[:, None]).reshape(-1, 3), left, rcond=None)[0]
    size, nominal = float(np.linalg.norm(gravity)), float(np.linalg.norm(arm.gravity))
    if size < 1e-6 or nominal < 1e-6:
        return arm
    turned = replace(arm, gravity=gravity * nominal / size)
    found, plain = fit_rigid(turned, motion).cost, fit_rigid(arm, motion).cost
    opposite = fit_rigid(arm, replace(motion, reading=-motion.reading)).cost
    upside_down = float(gravity @ arm.gravity) < -UPSIDE_DOWN * size * nominal
    if found.sum() > plain.sum() or found.mean() > np.log(MOUNTED + FLOOR):
        return arm
    return arm if upside_down and opposite.sum() < found.sum() + 0.3 else turned


def _joint(model: Array, motion: Motion, j: int, spring: bool) -> tuple[float, ...]:
    y = motion.reading[:, j] - motion.reading[:, j].mean()
    spread = float(y.std())
    columns = np.column_stack([model, np.clip(motion.v[:, j] / TURNING, -1.0, 1.0), motion.v[:, j], motion.a[:, j]])
    columns -= columns.mean(0)
    size = columns.std(0)
    if spread < 1e-9 or size[1] < 1e-6:  # nothing read, or a joint that rests
        return 1.0, 1.0, 0.0, 0.0, np.nan, spread
    units = np.where(size > 1e-9, size, 1.0)
    scaled = columns / units
    correlation, own = _partial(scaled, y)
    free = _solved(scaled.T @ scaled, scaled.T @ y) / units
    moves = np.mean(np.abs(motion.v[:, j]) > TURNING) >= MOVING_SHARE
    unsigned = motion.channel == "tau" or not moves
    signs = [(1.0,), *[(1.0, -1.0) if unsigned else (1.0,)] * 3]
    if spring and motion.q[:, j].std() > 1e-6:
        turned = (motion.q[:, j] - motion.q[:, j].mean()) / motion.q[:, j].std()
        scaled, signs = np.column_stack([scaled, turned]), [*signs, (1.0, -1.0)]
    coefficients, explained = _positive_fit(scaled, y, signs)
    own_share = own * float(units[0]) / spread
    friction = float(free[1]) if moves else np.nan
    return explained, float(coefficients[0] / units[0]), correlation, own_share, friction, spread


def _partial(columns: Array, y: Array) -> tuple[float, float]:
    """Correlation of y with the first column given the others, and the standard deviation of that column's own part."""
    gram = np.column_stack([columns, y]).T @ np.column_stack([columns, y])
    through = _solved(gram[1:-1, 1:-1], gram[1:-1, [0, -1]])
    left = gram[np.ix_([0, -1], [0, -1])] - gram[[0, -1], 1:-1] @ through
    own, rest = np.sqrt(np.maximum(np.diag(left), 0.0))
    return float(left[0, 1] / (own * rest + 1e-12)), float(own / np.sqrt(len(y)))


def _solved(gram: Array, side: Array) -> Array:
    return np.asarray(np.linalg.lstsq(gram, side, rcond=1e-12)[0])


def _positive_fit(columns: Array, y: Array, signs: Sequence[tuple[float, ...]]) -> tuple[Array, float]:
    """Coefficients, not negative, of the columns with each of their signs, and the share of y's variance explained.

    By the triangular factor of columns and y, which has the same least squares as they have. A sensor on the link feels
    no gear, and a joint at rest no friction: then the sign of those columns says nothing, and they have both.
    """
    small: Array = np.asarray(np.linalg.qr(np.column_stack([columns, y]), mode="r"))
    chosen = np.column_stack([sign * small[:, k] for k, both in enumerate(signs) for sign in both])
    coefficients, rest = nnls(chosen, small[:, -1])
    return coefficients, 1.0 - rest**2 / float(y @ y)


def few_rows(motion: Motion) -> Motion:
    """The motion with few rows, for a first look."""
    q, v, a, reading = (x[::FEW] for x in (motion.q, motion.v, motion.a, motion.reading))
    return Motion(q, v, a, reading, motion.channel)


def changed(motion: Motion, **values: Array) -> Motion:
    """The motion with some of its channels replaced."""
    return replace(motion, **values)  # type: ignore[arg-type]
