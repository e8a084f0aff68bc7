"""The torque of an arm without contact, learned from the arm's own work: mean, covariance, and how often it strays.

The rows of `gcomp.external.filtered_rows` are linear in the parameters, which have a prior (the records, or the model
with what sound arms lack) and are narrowed by recordings without contact. What is left over is judged by rows that the
fit has not seen. Its variance is a sum of components (at rest, at speed, while friction turns round, where the model is
not known), whose sizes are those of maximum likelihood.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, joined
from gcomp.external.filtered_rows import JOINT_COLUMNS, FilteredRows, RowFilter, Samples
from gcomp.external.rigid_motion import LINK_PARAMETERS, RigidMotion, gravity_split

NORMAL_95 = 1.959964
ROWS_RATE = 25.0
"""Rows a second [Hz]: as fast as the observer's bandwidth lets torque change."""
FOLDS = 8
ROUNDS = 3
CHUNK = 2000
"""Samples at a time."""
BEGINNING = 0.6
"""Left out at the begin of a recording [s]: friction of an arm in motion has found its direction then."""
SLOW = 1.5
"""Time constant of what a change is compared with [s]."""
SLOW_SHARE = float(1.0 - np.exp(-1.0 / (SLOW * ROWS_RATE)))
DRIFT = 120.0
"""Time constant with which what is left over for good is taken for a drift of the arm's own, as of sensors that warm
up [s]: of a push that lasts ten seconds a twelfth."""
SPEED, PUSH = 0.5, 1.0
"""Of the components of variance that grow with speed [rad/s] and acceleration [rad/s²]; scales alone."""


@dataclass(frozen=True, eq=False)
class ArmPrior:
    """Parameters before any recording: normal, as those of a sound arm of which this is known."""

    links: Array
    """Inertial parameters (n, 10) in the bar frames."""
    covariance: Array
    """Of the links' parameters as `gravity_split` has them (10 n, 10 n)."""
    joints: Array
    """(n, C) of `JOINT_COLUMNS` and the waves."""
    joints_std: Array
    """(n, C)."""
    noise: Array
    """Standard deviation of a row (n,) [N·m]."""

    @property
    def n(self) -> int:
        return len(self.links)


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """S rows of all joints."""

    left: Array
    """Filtered torque less what is expected (S, n) [N·m]; a contact's has the opposite sign."""
    columns: Array
    """By all of a joint's parameters (S, n, 10 n + C): the links', as `gravity_split` has them, and its own."""
    state: Array
    """Components of variance (S, n, B) but for the model's own."""
    motion: RigidMotion

    def __len__(self) -> int:
        return len(self.left)

    @property
    def by_link(self) -> Array:
        """(S, n, 10 n)."""
        return self.columns[..., : LINK_PARAMETERS * self.left.shape[1]]

    @property
    def by_joint(self) -> Array:
        """(S, n, C)."""
        return self.columns[..., LINK_PARAMETERS * self.left.shape[1] :]

    def part(self, rows: slice | Mask) -> "TorqueRows":
        return TorqueRows(self.left[rows], self.columns[rows], self.state[rows], self.motion.part(rows))


def rows_of(filtered: FilteredRows, split: Array, joints: Array) -> TorqueRows:
    chosen = filtered.chosen
    own = filtered.joints[chosen]
    left = filtered.torque[chosen] - filtered.links[chosen] - (own * joints).sum(-1)
    columns = np.concatenate([filtered.by_link @ split, own], axis=-1)
    return TorqueRows(left, columns, _state(filtered.state[chosen]), filtered.motion)


def _state(state: Array) -> Array:
    """Components of a joint's variance: constant, of its own state (S, n, 5), and of how the whole arm moves."""
    out = np.empty((*state.shape[:-1], COMPONENTS - 1))
    out[..., 0], out[..., 1:3] = 1.0, state[..., :2]
    out[..., 3:5] = (state[..., 2:4] / (SPEED, PUSH)) ** 2
    out[..., 5:7] = out[..., 3:5].mean(axis=1, keepdims=True)
    out[..., 7] = state[..., 4] ** 2
    return out


COMPONENTS = 9
"""Those of `_state`, and the model's own."""


@dataclass(frozen=True, eq=False)
class Spread:
    """How far rows of an arm without contact lie from what is expected."""

    weights: Array
    """Of the components of variance (n, B)."""
    still: Array
    """Factor on the standard deviation at rest (n,) but for the model's own part, that makes 95 % of the rows lie
    within their bounds."""
    moving: Array
    """The same in motion (n,)."""
    correlation: Array
    """Of the joints (n, n)."""

    @cached_property
    def precision(self) -> Array:
        """Inverse of the correlation (n, n)."""
        return np.asarray(np.linalg.inv(self.correlation))

    def std(self, state: Array, model: Array) -> Array:
        """(S, n) [N·m], from the components and the model's own variance (S, n)."""
        share = state[..., 1]
        factor = share * self.still + (1.0 - share) * self.moving
        own = (state * self.weights[:, :-1]).sum(-1) * factor**2
        return np.asarray(np.sqrt(own + self.weights[:, -1] * model))

    def deviation(self, left: Array, std: Array) -> Array:
        """Square of the distance from nothing (S,), in standard deviations over all joints."""
        scaled = left / std
        return np.asarray(np.einsum("si,ij,sj->s", scaled, self.precision, scaled))


@dataclass(frozen=True, eq=False)
class ExternalModel:
    """The torque that is expected, and how sure that is."""

    arm: Arm
    links: Array
    """Inertial parameters (n, 10) in the bar frames."""
    joints: Array
    """Each joint's own parameters (n, C)."""
    factors: Array
    """For each joint, factor of the covariance of the links' parameters, as `gravity_split` has them, and of its own,
    (n, Q, Q)."""
    lasting: Spread
    """Of rows."""
    sudden: Spread
    """Of rows less what they were before, over `SLOW`."""
    maxima: tuple[Array, Array]
    """Largest deviations of each stretch of the arm's own work, of rows and of their changes; empty without any."""
    scale: Array
    """(n,) [N·m], in which joints compare."""
    seconds: float = 0.0
    """Of the arm's own work that it rests on."""

    @cached_property
    def split(self) -> Array:
        return gravity_split(self.arm)

    def filter(self, rate: float) -> RowFilter:
        """For samples of this rate [Hz]."""
        return RowFilter(self.arm, self.links, rate, stride_of(rate))

    def rows(self, filtered: FilteredRows) -> TorqueRows:
        return rows_of(filtered, self.split, self.joints)


def stride_of(rate: float) -> int:
    return max(1, round(rate / ROWS_RATE))


def expected(rows: TorqueRows, change: Array) -> Array:
    n = rows.left.shape[1]
    shared = LINK_PARAMETERS * n
    own = change[shared:].reshape(n, -1)
    return np.asarray(rows.by_link @ change[:shared] + (rows.by_joint * own).sum(-1))


def model_variance(columns: Array, factors: Array) -> Array:
    """Variance (S, n) of the torque that columns (S, n, Q) expect [N²·m²]."""
    spread = columns.swapaxes(0, 1) @ factors
    return np.asarray(np.einsum("jsq,jsq->sj", spread, spread))


def _factors(covariance: Array, n: int) -> Array:
    """Factors (n, Q, Q) of each joint's part of the covariance of all parameters."""
    shared = LINK_PARAMETERS * n
    own = (len(covariance) - shared) // n
    found = []
    for j in range(n):
        place = np.append(np.arange(shared), shared + j * own + np.arange(own))
        values, vectors = np.linalg.eigh(covariance[np.ix_(place, place)])
        found.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    return np.array(found)


def from_records(arm: Arm, prior: ArmPrior, scale: Array) -> ExternalModel:
    """Without any work of the arm's own: the records' bounds alone, which nothing has proved."""
    n = prior.n
    covariance = _prior_covariance(prior)
    weights = np.zeros((n, COMPONENTS))
    weights[:, 0], weights[:, -1] = prior.noise**2, 1.0
    friction = prior.joints[:, JOINT_COLUMNS.index("coulomb")]
    weights[:, 1] = weights[:, 2] = friction**2  # at rest it may push either way
    spread = Spread(weights, np.ones(n), np.ones(n), np.eye(n))
    nothing = np.empty(0)
    return ExternalModel(
        arm, prior.links, prior.joints, _factors(covariance, n), spread, spread, (nothing, nothing), scale
    )


def learn(arm: Arm, prior: ArmPrior, runs: Sequence[Samples], rate: float, scale: Array) -> ExternalModel:
    """From recordings without contact, of one rate [Hz]."""
    split, parts = gravity_split(arm), []
    for run in runs:
        made = RowFilter(arm, prior.links, rate, stride_of(rate))
        chunks = (run.part(slice(begin, begin + CHUNK)) for begin in range(0, len(run), CHUNK))
        own = [rows_of(made.rows(chunk), split, prior.joints) for chunk in chunks]
        parts.append(joined(own).part(slice(round(BEGINNING * ROWS_RATE), None)))
    folds = _folds(parts)
    pieces = [part for part in parts if len(part)]
    fit = _Fit(prior, pieces, folds)
    mean, covariance, left, own_variance, change, change_variance = fit.result()
    state = np.concatenate([piece.state for piece in pieces])
    runs_of = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    for k in range(len(pieces)):
        left[runs_of == k] -= drift(left[runs_of == k])
    lasting, std = _spread(state, own_variance, left)
    sudden, sudden_std = _spread(state, change_variance, change)
    maxima = tuple(
        np.concatenate([block_maxima(spread.deviation(x, s)[runs_of == k]) for k in range(len(pieces))])
        for spread, x, s in ((lasting, left, std), (sudden, change, sudden_std))
    )
    seconds, shared = len(left) / ROWS_RATE, LINK_PARAMETERS * arm.n
    links = prior.links + (split @ mean[:shared]).reshape(arm.n, LINK_PARAMETERS)
    joints = prior.joints + mean[shared:].reshape(arm.n, -1)
    return ExternalModel(
        arm, links, joints, _factors(covariance, arm.n), lasting, sudden, (maxima[0], maxima[1]), scale, seconds
    )


def change_of(rows: TorqueRows) -> TorqueRows:
    """Rows less what they were before."""
    left, columns = (each - slow_mean(each) for each in (rows.left, rows.columns))
    return TorqueRows(left, columns, rows.state, rows.motion)


def drift(left: Array) -> Array:
    """Drift of the zeros before each row (S, n), as far as the rows before show it."""
    from scipy.signal import lfilter

    share = 1.0 / (DRIFT * ROWS_RATE)
    return np.asarray(lfilter([0.0, share], [1.0, share - 1.0], left, axis=0))


def slow_mean(left: Array) -> Array:
    """Mean of the rows before each one (S, …), exponentially over `SLOW`."""
    out, value = np.empty_like(left), left[0].copy()
    for row, each in enumerate(left):
        out[row] = value
        value += slow_weight(row + 1) * (each - value)
    return out


def slow_weight(count: int) -> float:
    """Weight of the newest of so many rows in their mean, exponentially over `SLOW`."""
    return max(SLOW_SHARE, 1.0 / max(count, 1))


FEWEST_ROWS = 100
"""From which the factor of the bounds is taken."""
FACTORS = (0.3, 5.0)
"""Range of that factor."""
LEAST_VARIANCE = 0.04
"""Of a row in any state, as a share of the mean over all states: states that the arm's own work hardly had are not as
sure as they looked."""
BLOCK = 2.0
"""Stretch of which the largest deviation counts [s]: longer than deviations of one cause last."""


def block_maxima(deviation: Array) -> Array:
    size = round(BLOCK * ROWS_RATE)
    whole = len(deviation) // size
    return np.asarray(deviation[: whole * size].reshape(whole, size).max(axis=1))


def _folds(parts: Sequence[TorqueRows]) -> NDArray[np.intp]:
    """Fold of each row: recordings, or stretches of them where there are few."""
    filled = [len(part) for part in parts if len(part)]
    if len(filled) >= FOLDS // 2:
        return np.repeat(np.arange(len(filled)) % FOLDS, filled)
    total = sum(filled)
    return np.asarray(np.arange(total) * FOLDS // max(total, 1), dtype=np.intp)


def _prior_covariance(prior: ArmPrior) -> Array:
    shared, own = prior.covariance, prior.joints_std.ravel() ** 2
    covariance = np.zeros((len(shared) + own.size,) * 2)
    covariance[: len(shared), : len(shared)] = shared
    covariance[np.arange(len(shared), len(covariance)), np.arange(len(shared), len(covariance))] = own
    return covariance


class _Fit:
    """Normal equations by fold; each fold's rows are judged by a fit to the others."""

    def __init__(self, prior: ArmPrior, pieces: Sequence[TorqueRows], folds: NDArray[np.intp]) -> None:
        self.prior, self.folds = prior, folds
        self.rows = joined(pieces)
        self.change = joined([change_of(piece) for piece in pieces])
        n, self.shared = prior.n, LINK_PARAMETERS * prior.n
        covariance = _prior_covariance(prior)
        self.scale = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
        relative = covariance / np.outer(self.scale, self.scale) + 1e-9 * np.eye(len(covariance))
        self.precision = np.linalg.inv(relative)
        self.normal = np.zeros((FOLDS, n, len(self.scale), len(self.scale)), dtype=np.float32)
        self.right = np.zeros((FOLDS, n, len(self.scale)))
        for fold in range(FOLDS):
            for j in range(n):
                place, design = self._design(j, folds == fold)
                self.normal[fold, j][np.ix_(place, place)] = design.T @ design
                self.right[fold, j, place] = design.T @ self.rows.left[folds == fold, j]

    def _design(self, j: int, rows: Mask) -> tuple[NDArray[np.intp], Array]:
        own = self.rows.columns.shape[2] - self.shared
        place = np.append(np.arange(self.shared), self.shared + j * own + np.arange(own))
        return place, self.rows.columns[rows, j] * self.scale[place]

    def result(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Mean (P,) and covariance (P, P) of the parameters; what is left of rows not seen, the model's variance of it,
        and both of the rows' changes, (S, n) each."""
        noise, repeats = self.prior.noise.copy(), np.ones(self.prior.n)
        for _ in range(ROUNDS):
            weight = 1.0 / (noise**2 * repeats)
            left, *others = self._judged(weight)
            noise = np.sqrt(np.mean(left**2, axis=0)) + 1e-9
            repeats = np.array([_repeats(left[:, j]) for j in range(self.prior.n)])
        normal = self.precision + np.einsum("fjab,j->ab", self.normal, weight)
        covariance = np.linalg.inv(normal)
        mean = covariance @ np.einsum("fja,j->a", self.right, weight)
        variance, change, change_variance = others
        return mean * self.scale, covariance * np.outer(self.scale, self.scale), left, variance, change, change_variance

    def _judged(self, weight: Array) -> tuple[Array, Array, Array, Array]:
        normal = np.einsum("fjab,j->fab", self.normal, weight)
        right = np.einsum("fja,j->fa", self.right, weight)
        out = np.empty((4, *self.rows.left.shape))
        for fold in np.unique(self.folds):
            own = self.folds == fold
            covariance = np.linalg.inv(self.precision + normal.sum(0) - normal[fold])
            mean = covariance @ (right.sum(0) - right[fold]) * self.scale
            factors = _factors(covariance * np.outer(self.scale, self.scale), self.prior.n)
            for k, rows in enumerate((self.rows, self.change)):
                part = rows.part(own)
                out[2 * k, own] = part.left - expected(part, mean)
                out[2 * k + 1, own] = model_variance(part.columns, factors)
        return out[0], out[1], out[2], out[3]


def _repeats(left: Array) -> float:
    """Rows that tell as much as one independent one: neighbours are alike."""
    centred = left - left.mean()
    power = float(centred @ centred) + 1e-300
    total = 1.0
    for lag in range(1, min(len(left) // 4, round(20 * ROWS_RATE))):
        alike = float(centred[lag:] @ centred[:-lag]) / power
        if alike < 0.05:
            break
        total += 2.0 * alike
    return total


def _spread(state: Array, model: Array, left: Array) -> tuple[Spread, Array]:
    """Sizes of the components by maximum likelihood; then the factors of the bounds, by their 95 % quantile."""
    n = left.shape[1]
    weights, still, moving = np.empty((n, COMPONENTS)), np.ones(n), np.ones(n)
    parts = np.concatenate([state, model[..., None]], axis=-1)
    for j in range(n):
        weights[j] = variance_components(parts[:, j], left[:, j] ** 2)
        weights[j, -1] = max(weights[j, -1], 1.0)
    own, known = (state * weights[:, :-1]).sum(-1), weights[:, -1] * model
    for j in range(n):
        rest = state[:, j, 1] > 0.5
        for chosen, out in ((rest, still), (~rest, moving)):
            if chosen.sum() >= FEWEST_ROWS:
                out[j] = factor_of_95(left[chosen, j], own[chosen, j], known[chosen, j])
        if rest.sum() < FEWEST_ROWS:
            still[j] = moving[j]
        if (~rest).sum() < FEWEST_ROWS:
            moving[j] = still[j]
    spread = Spread(weights, still, moving, np.eye(n))
    std = spread.std(state, model)
    scaled = np.clip(left / std, -4.0, 4.0)
    second = scaled.T @ scaled / len(scaled) + 0.2 * np.eye(n)
    size = np.sqrt(np.diag(second))
    return Spread(weights, still, moving, second / np.outer(size, size)), std


def factor_of_95(left: Array, own: Array, known: Array) -> float:
    """Factor f with which a new row lies within the bounds of variances f² own + known in 95 %.

    Of k independent values the r-th smallest is not exceeded by a new one with probability r / (k + 1). All rows of a
    rest are one such value: the same friction holds them.
    """
    needed = np.sqrt(np.maximum((left / NORMAL_95) ** 2 - known, 0.0) / own)
    independent = len(needed) / _repeats(needed)
    return float(np.clip(np.quantile(needed, min(0.95 * (1.0 + 1.0 / independent), 1.0)), *FACTORS))


def variance_components(parts: Array, square: Array) -> Array:
    """Weights (B,) ≥ 0 of components (S, B) of a normal variable's variance, by maximum likelihood.

    Each step raises the likelihood (majorisation: Hunter and Lange, The American Statistician 58, 2004).
    """
    mean = float(square.mean()) + 1e-24
    typical = parts.mean(axis=0)
    weights = mean / np.maximum(typical, 1e-12) / parts.shape[1]
    weights[typical < 1e-12] = 0.0
    least = LEAST_VARIANCE * mean
    for _ in range(200):
        variance = parts @ weights + least
        up = parts.T @ (square / variance**2)
        down = parts.T @ (1.0 / variance)
        weights = weights * np.sqrt(up / np.maximum(down, 1e-300))
    weights[0] += least
    return np.asarray(weights)
