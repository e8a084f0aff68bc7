"""Refinement of the sensor fit: effects beyond the sensor model, as extra linear columns (docs/theory.md, section 5.4).

A rounded position has the same error in every reading taken there, so the rounding of each distinct position is an
unknown of its own, with a prior. So are the small troubles of a real arm, whose levels are learned from the readings
by restricted maximum likelihood (section 4.6). Effects that stand out against these (hysteresis, a spring) enter in the
same way, without a prior. Gauss-Newton from the global fit; each joint's noise is scaled to the scatter found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg

from calib.fit.calibration import NOISE_ROUNDS
from calib.fit.small_troubles import FAMILIES, LARGEST, UNITS, Setting, Troubles, troubles
from calib.fit.sweep_readings import FEWEST, SweepReadings
from gcomp.arrays import Array
from gcomp.identify.global_fit import GlobalFit
from gcomp.identify.identifiability import analyse, describe_null_space
from gcomp.identify.parameters import Parameters, Prior, natural_units, parameter_names, prior_vectors
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict_and_jacobian

ROUNDS, SETTLED, LONGEST = 30, 0.01, 1.0
"""Steps at most; longest and last step, in the logarithm of a level."""
WEIGHT = 2.0
"""Coefficients that the arm's common level counts for in each family: an arm is good or bad in all that it is, and a
family that hardly shows keeps a level instead of none, which would make the intervals certain of what the readings do
not tell."""
UNKNOWN = 2.0
"""Standard deviation beforehand of the common level's logarithm about that of good arms: a factor of seven."""
LEAST = 2e-3
"""Least level; it only bounds the search. Perfect arms come to 0.005 to 0.02, where the readings end it; at a bound of
0.02 their offsets were said to be known up to a third worse than they are."""


@dataclass(frozen=True, eq=False)
class RandomEffects:
    """Normal equations of m random effects, what parameters and nuisances can explain taken out."""

    square: Array
    """(m, m)."""
    right: Array
    family: npt.NDArray[np.int64]
    """Family of each effect (m,)."""
    families: int

    @classmethod
    def of(
        cls, fixed: Array, effects: Array, target: Array, family: npt.NDArray[np.int64], families: int
    ) -> "RandomEffects":
        """From weighted rows: fixed columns (P, f) and priors below (P + priors, f), effects (P, m), target likewise.

        The fixed columns are in units in which a standard deviation of 1 is no knowledge.
        """
        padded = np.vstack([effects, np.zeros((len(fixed) - len(effects), effects.shape[1]))])
        square = fixed.T @ fixed + np.eye(fixed.shape[1])
        factor = linalg.cho_factor(square, lower=True, check_finite=False)
        across, along = fixed.T @ padded, fixed.T @ target
        taken = linalg.cho_solve(factor, np.column_stack([across, along]), check_finite=False)
        return cls(
            effects.T @ effects - across.T @ taken[:, :-1],
            effects.T @ target[: len(effects)] - across.T @ taken[:, -1],
            family,
            families,
        )


@dataclass(frozen=True, eq=False)
class Levels:
    level: Array
    """One a family, in its unit (F,)."""
    freedom: Array
    """How many coefficients of each family the readings tell (F,)."""
    covariance: Array
    """Of the levels' logarithms (F, F)."""


def learn(effects: RandomEffects, start: Array, largest: Array) -> Levels:
    """Levels of all families (F,), at most `largest`, by Fisher scoring in their logarithms, with a common level.

    A family has the inverse χ² prior of WEIGHT coefficients at the common level, which is unknown within the range.
    """
    count = effects.families
    theta = np.append(np.log(start), np.log(start).mean())
    most = np.log(np.append(largest, largest.min()))
    for _ in range(ROUNDS):
        score, told, hessian = _scored(effects, theta)
        step = np.clip(-np.linalg.solve(hessian, score), -LONGEST, LONGEST)
        before, theta = theta, np.clip(theta + step, np.log(LEAST), most)
        if np.abs(theta - before).max() < SETTLED:
            break
    covariance: Array = np.asarray(2 * np.linalg.inv(hessian), dtype=np.float64)
    return Levels(np.exp(theta[:count]), told, covariance[:count, :count])


def _scored(effects: RandomEffects, theta: Array) -> tuple[Array, Array, Array]:
    """Of (M) and the prior at log levels (F + 1,), the common one last: gradient, freedom (F,), expected Hessian."""
    count, family = effects.families, effects.family
    level = np.exp(theta[:count])
    of_each = level[family]
    square = of_each[:, None] * effects.square * of_each
    square[np.diag_indices_from(square)] += 1.0
    below = np.tril(linalg.lapack.dpotri(linalg.cholesky(square, lower=True, check_finite=False), lower=True)[0])
    inverse = below + np.tril(below, -1).T
    shown = np.eye(len(square)) - inverse
    value = inverse @ (of_each * effects.right)  # in levels
    member = (family == np.arange(count)[:, None]).astype(float)
    freedom = member @ np.diag(shown)
    pull = np.exp(2 * np.minimum(theta[-1] - theta[:count], 1.0))
    gradient = np.append(2 * (freedom - member @ value**2 + WEIGHT * (1 - pull)), 2 * WEIGHT * (pull - 1).sum())
    gradient[-1] += 2 * theta[-1] / UNKNOWN**2
    hessian = np.zeros((count + 1, count + 1))
    hessian[:count, :count] = 4 * member @ shown**2 @ member.T + 4 * WEIGHT * np.eye(count)
    hessian[:count, -1] = hessian[-1, :count] = -4 * WEIGHT
    hessian[-1, -1] = 4 * WEIGHT * count + 2 / UNKNOWN**2
    return gradient, freedom, hessian


WITHIN = 0.2
"""Standard deviation of the part of a held joint's lag that changes during a sweep, in levels of `direction`: half of
ROUGHLY, a choice."""
LEAST_FACTOR = 0.5
"""Least scatter over the samples' noise; it only bounds the search. Less than 1 is by chance, but so is as much more:
cut off at 1, the intervals of perfect arms were 5 % too wide."""
NEGLIGIBLE = 0.1
"""Share of a reading's noise below which rounding is neglected: it adds 0.5 % to the standard deviation."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The fit, linearised at its end: P counted readings; p parameters, rounding and extra columns."""

    row: npt.NDArray[np.int64]
    """Row of each counted reading (P,)."""
    joint: npt.NDArray[np.int64]
    """Its joint (P,)."""
    sigma: Array
    """Its standard deviation, position rounding not counted (P,) [N·m]."""
    annihilator: Array
    """M (P, P) with residual = M · (what the readings say beyond the start): takes out what parameters, rounding and
    small troubles can do, each as far as its prior lets it."""
    residual: Array
    """Residuals of the readings in standard deviations (P,)."""

    precision: Array
    """Inverse covariance (P, P) of the readings in standard deviations, rounding and small troubles included."""
    design: Array
    """Columns of the fit's parameters, in standard deviations (P, p)."""
    effects: Array
    """Columns of the small troubles, each at its level, in standard deviations (P, m)."""
    levels: Levels
    """Of the small troubles."""
    troubles: Troubles
    solution: Array
    """Change of the free parameters, then the extra columns' coefficients."""
    triangle: Array
    """Upper triangle of the whitened design, parameters and extra columns (p + m, p + m)."""

    @property
    def leverage(self) -> Array:
        """Leverage of each reading on its own prediction (P,), 0 to 1."""
        return 1 - np.diag(self.annihilator)


@dataclass(frozen=True, eq=False)
class Refined:
    """The global fit with rounding and extra columns."""

    fit: GlobalFit
    factor: Array
    """Scatter of each joint's readings over their samples' noise (n,)."""
    linear: Linear
    coefficients: Array
    """Of the extras, in their units (m,)."""
    certainty: Parameters
    """Degrees of freedom of each parameter's standard deviation, since noise and levels are estimates."""


def refine(
    rows: SweepReadings,
    setting: Setting,
    fit: GlobalFit,
    priors: Mapping[str, Prior],
    extras: Sequence[Array] = (),
) -> Refined:
    """Refine a global fit with the small troubles of `setting` as random effects.

    `extras` are further columns, the change of the torque readings (K, n) per unit of an effect each.
    """
    kinematics, readings = setting.arm, rows.readings
    problem = _Problem(rows, setting, fit, priors, extras)
    vector, factor, count = fit.complete.vector.copy(), np.ones(kinematics.n), int(problem.free.sum())
    level = np.ones(len(FAMILIES))
    for _ in range(NOISE_ROUNDS):
        linear = problem.linearised(vector, factor, level)
        level = linear.levels.level
        vector[problem.free] += linear.solution[:count]
        raw, freedom = _scatter(linear, kinematics.n)
        factor = np.maximum(factor * np.where(np.isnan(raw), 1.0, raw), LEAST_FACTOR)
    found = analyse(linear.triangle, problem.scale)
    troubled = linear.effects @ (linear.effects.T @ linear.residual)
    determined, covariance = found.determined[:count], found.covariance[:count, :count]
    deviation = np.zeros(len(vector))
    deviation[problem.free] = np.where(determined, np.sqrt(np.abs(np.diag(covariance))), np.inf)
    refined = replace(
        fit,
        values=Parameters.from_vector(np.where(np.isinf(deviation), np.nan, vector), kinematics.n),
        std=Parameters.from_vector(deviation, kinematics.n),
        complete=Parameters.from_vector(vector, kinematics.n),
        covariance=covariance,
        identifiable=determined,
        null_space=describe_null_space(found.null_basis[:count], fit.names),
        residual=readings.table((linear.residual + troubled) * linear.sigma),
        chi2=float(linear.residual @ linear.residual),
        dof=round(float(freedom.sum())),
    )
    certainty = np.full(len(vector), 1.0)
    certainty[problem.free] = _certainty(linear, np.nan_to_num(covariance), freedom)
    sure = Parameters.from_vector(certainty, kinematics.n)
    return Refined(refined, factor, linear, linear.solution[count:], sure)


def _certainty(linear: Linear, covariance: Array, free: Array) -> Array:
    """Degrees of freedom (p,) of the parameters' variances, by Satterthwaite: 2 v² over the variance of v.

    v consists of each joint's noise, known from its `free` (n,) readings, and one part a family, in proportion to its
    level's square. Extra columns are left out of account.
    """
    families = np.arange(len(FAMILIES))
    weight = linear.precision @ (linear.design @ covariance)
    parts = (linear.troubles.family == families[:, None]).astype(float) @ (linear.effects.T @ weight) ** 2
    noise = (linear.joint == np.arange(len(free))[:, None]).astype(float) @ weight**2
    variance = np.maximum(np.diag(covariance), 1e-300)
    spread = 4 * np.einsum("fp,fg,gp->p", parts, linear.levels.covariance, parts)
    spread += (2 * noise**2 / np.maximum(free, 1.0)[:, None]).sum(axis=0)
    certainty: Array = 2 * variance**2 / np.maximum(spread, 1e-300)
    return np.maximum(certainty, 1.0)


class _Problem:
    """Parts of the problem that are the same in every step."""

    def __init__(
        self,
        rows: SweepReadings,
        setting: Setting,
        fit: GlobalFit,
        priors: Mapping[str, Prior],
        extras: Sequence[Array],
    ) -> None:
        self.rows, self.setting = rows, setting
        kinematics, readings = setting.arm, rows.readings
        self.arm, self.readings = kinematics, readings
        self.free = np.array([name in fit.names for name in parameter_names(kinematics)])
        self.mean, self.std = (values[self.free] for values in prior_vectors(kinematics.n, priors))
        self.row, self.joint = np.nonzero(readings.counted)
        count = len(self.row)
        self.columns = np.column_stack([np.zeros((count, 0)), *(column[readings.counted] for column in extras)])
        torque = float(np.abs(readings.torque[readings.counted]).max())
        sizes = torque / np.maximum(np.abs(self.columns).max(axis=0, initial=0.0), 1e-9)
        self.scale = np.concatenate([natural_units(kinematics, readings, fit.complete)[self.free], sizes])

    def linearised(self, vector: Array, factor: Array, level: Array) -> Linear:
        """The problem linearised, and solved, at a parameter vector (6n + 3,), noise times factor (n,)."""
        readings, free = self.readings, int(self.free.sum())
        modelled, jacobian, slope = predict_and_jacobian(self.arm, Parameters.from_vector(vector, self.arm.n), readings)
        lag = WITHIN * level[FAMILIES.index("direction")] * UNITS["direction"][0] * self.setting.rated[self.joint]
        own = self.rows.swept[self.row] == self.joint
        sigma = np.hypot(readings.sigma[readings.counted], np.where(own, 0.0, lag)) * factor[self.joint]
        rounding = _rounding_columns(readings, self.rows.resolution, slope / sigma[:, None])
        found = troubles(self.setting, self.rows, Parameters.from_vector(vector, self.arm.n))
        informed = np.flatnonzero(np.isfinite(self.std))
        count, known = len(sigma), len(informed)
        rows = count + known
        design, target = np.zeros((rows, free + self.columns.shape[1])), np.zeros(rows)
        design[:count] = np.hstack([jacobian[:, self.free], self.columns]) / sigma[:, None]
        target[:count] = (readings.torque[readings.counted] - modelled) / sigma
        design[np.arange(count, count + known), informed] = 1 / self.std[informed]
        target[count : count + known] = ((self.mean - vector[self.free]) / self.std)[informed]
        weighted = found.columns / sigma[:, None]
        nuisance = np.vstack([rounding, np.zeros((known, rounding.shape[1]))])
        fixed = np.hstack([design * self.scale, nuisance])
        effects = RandomEffects.of(fixed, weighted, target, found.family, len(FAMILIES))
        levels = learn(effects, level, LARGEST)
        random = np.hstack([rounding, weighted * levels.level[found.family]])
        root = np.linalg.cholesky(np.eye(count) + random @ random.T)
        whitened = linalg.solve_triangular(root, np.column_stack([design[:count], target[:count]]), lower=True)
        rest = np.vstack([whitened[:, :-1], design[count:]])
        aim = np.concatenate([whitened[:, -1], target[count:]])
        left, values, right = np.linalg.svd(rest * self.scale, full_matrices=False)
        keep = values > max(1.0, 1e-7 * values[0])
        solution = self.scale * (right[keep].T @ ((left[:, keep].T @ aim) / values[keep]))
        inverse = linalg.solve_triangular(root, np.eye(count), lower=True)
        part = inverse.T @ left[:count, keep]
        residual = inverse.T @ (whitened[:, -1] - whitened[:, :-1] @ solution)
        precision = inverse.T @ inverse
        triangle: Array = np.asarray(np.linalg.qr(rest, mode="r"), dtype=np.float64)
        return Linear(
            self.row,
            self.joint,
            sigma,
            precision - part @ part.T,
            residual,
            precision,
            design[:count, :free],
            random[:, rounding.shape[1] :],
            levels,
            found,
            solution,
            triangle,
        )


def _scatter(linear: Linear, n: int) -> tuple[Array, Array]:
    """(Scatter over its expected value, NaN with too few free readings; free readings) of each joint (n,)."""
    free: Array = np.bincount(linear.joint, 1 - linear.leverage, minlength=n).astype(np.float64)
    total = np.bincount(linear.joint, linear.residual**2, minlength=n)
    ratio: Array = np.where(free >= FEWEST, np.sqrt(total / np.maximum(free, 1e-9)), np.nan)
    return ratio, free


def _rounding_columns(readings: StaticReadings, resolution: Array, slope: Array) -> Array:
    """Change of the readings (P, m) per standard deviation of each distinct position's rounding, in their own.

    slope (P, n) is the derivative of each reading by each position, in standard deviations per rad. Joints whose
    rounding is negligible are left out.
    """
    row = np.nonzero(readings.counted)[0]
    columns = [np.zeros((len(row), 0))]
    for joint in np.flatnonzero(resolution > 0):
        size = slope[:, joint] * resolution[joint] / np.sqrt(12.0)
        if np.abs(size).max() < NEGLIGIBLE:
            continue
        counts = np.rint(readings.position[row, joint] / resolution[joint])
        _, place = np.unique(counts, return_inverse=True)
        column = np.zeros((len(row), int(place.max()) + 1))
        column[np.arange(len(row)), place] = size
        columns.append(column)
    return np.hstack(columns)
