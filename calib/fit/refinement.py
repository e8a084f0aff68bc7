"""Refinement of the sensor fit: effects beyond the sensor model, as extra linear columns (docs/theory.md, section 5.4).

A rounded position has the same error in every reading taken there, so the rounding of each distinct position is an
unknown of its own, with a prior. So are the small troubles of a real arm, whose levels are learned from the readings
(section 4.6). Effects that stand out against these (hysteresis, a spring) enter in the same way, without a prior.
Gauss-Newton from the global fit; each joint's noise is scaled to the scatter found.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg

from calib.fit.levels import Levels, RandomEffects, learn
from calib.fit.scatter import NOISE_ROUNDS
from calib.fit.small_troubles import FAMILIES, LARGEST, UNITS, Setting, Troubles, troubles
from calib.fit.sweep_readings import SweepReadings
from gcomp.arrays import Array
from gcomp.identify.global_fit import GlobalFit
from gcomp.identify.identifiability import analyse, describe_null_space
from gcomp.identify.parameters import Parameters, Prior, natural_units, parameter_names, prior_vectors
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict_and_jacobian

WITHIN = 0.2
"""Standard deviation of the part of a held joint's lag that changes during a sweep, in levels of `direction`: half of
ROUGHLY, a choice."""
LEAST_FACTOR = 0.5
"""Least scatter over the samples' noise; it only bounds the search. Less than 1 is by chance, but so is as much more:
cut off at 1, the intervals of perfect arms were 5 % too wide."""
NEGLIGIBLE = 0.1
"""Share of a reading's noise below which rounding is neglected: it adds 0.5 % to the standard deviation."""
FEWEST = 8.0
"""Free readings of a joint for an estimate of its scatter: known to 25 % then (1/√(2 · 8))."""


@dataclass(frozen=True, eq=False)
class Extra:
    """An extra column: change of the torque readings per unit of an effect."""

    joint: int
    """Index of the joint whose sensor shows the effect."""
    kind: str
    column: Array
    """By reading (K, n)."""


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

    @property
    def leverage(self) -> Array:
        """Leverage of each reading on its own prediction (P,), 0 to 1."""
        part: Array = 1 - np.diag(self.annihilator)
        return part


@dataclass(frozen=True, eq=False)
class Refined:
    """The global fit with rounding and extra columns."""

    fit: GlobalFit
    factor: Array
    """Scatter of each joint's readings over their samples' noise (n,)."""
    linear: Linear
    coefficients: Array
    """Of the extras, in their units (m,)."""
    levels: Levels
    """Of the small troubles."""
    troubles: Troubles
    certainty: Parameters
    """Degrees of freedom of each parameter's standard deviation, since noise and levels are estimates."""


def refine(
    rows: SweepReadings,
    setting: Setting,
    fit: GlobalFit,
    priors: Mapping[str, Prior],
    extras: tuple[Extra, ...] = (),
) -> Refined:
    """Refine a global fit with the small troubles of `setting` as random effects."""
    kinematics, readings = setting.arm, rows.readings
    problem = _Problem(rows, setting, fit, priors, extras)
    vector, factor = fit.complete.vector.copy(), np.ones(kinematics.n)
    level = np.ones(len(FAMILIES))
    for _ in range(NOISE_ROUNDS):
        step = problem.step(vector, factor, level)
        level = step.levels.level
        vector[problem.free] += step.solution[: step.parameters]
        raw, freedom = _scatter(step.linear, kinematics.n)
        factor = np.maximum(factor * np.where(np.isnan(raw), 1.0, raw), LEAST_FACTOR)
    found = analyse(step.triangle, step.scale)
    inner, behind = slice(0, step.parameters), slice(step.parameters, None)
    residual = np.full(readings.torque.shape, np.nan)
    troubled = step.linear.effects @ (step.linear.effects.T @ step.linear.residual)
    residual[readings.counted] = (step.linear.residual + troubled) * step.linear.sigma
    determined, covariance = found.determined[inner], found.covariance[inner, inner]
    deviation = np.zeros(len(vector))
    deviation[problem.free] = np.where(determined, np.sqrt(np.abs(np.diag(covariance))), np.inf)
    scaled = step.linear.residual
    refined = replace(
        fit,
        values=Parameters.from_vector(np.where(np.isinf(deviation), np.nan, vector), kinematics.n),
        std=Parameters.from_vector(deviation, kinematics.n),
        complete=Parameters.from_vector(vector, kinematics.n),
        covariance=covariance,
        identifiable=determined,
        null_space=describe_null_space(found.null_basis[inner], fit.names),
        residual=residual,
        chi2=float(scaled @ scaled),
        dof=round(float(freedom.sum())),
    )
    certainty = np.full(len(vector), 1.0)
    certainty[problem.free] = _certainty(step, np.nan_to_num(covariance), freedom)
    return Refined(
        refined,
        factor,
        step.linear,
        step.solution[behind],
        step.levels,
        step.troubles,
        Parameters.from_vector(certainty, kinematics.n),
    )


def _certainty(step: "_RefinementStep", covariance: Array, free: Array) -> Array:
    """Degrees of freedom (p,) of the parameters' variances, by Satterthwaite: 2 v² over the variance of v.

    v consists of each joint's noise, known from its `free` (n,) readings, and one part a family, in proportion to its
    level's square. Extra columns are left out of account.
    """
    linear, families = step.linear, np.arange(len(FAMILIES))
    weight = linear.precision @ (linear.design @ covariance)
    parts = (step.troubles.family == families[:, None]).astype(float) @ (linear.effects.T @ weight) ** 2
    noise = (linear.joint == np.arange(len(free))[:, None]).astype(float) @ weight**2
    variance = np.maximum(np.diag(covariance), 1e-300)
    spread = 4 * np.einsum("fp,fg,gp->p", parts, step.levels.covariance, parts)
    spread += (2 * noise**2 / np.maximum(free, 1.0)[:, None]).sum(axis=0)
    certainty: Array = 2 * variance**2 / np.maximum(spread, 1e-300)
    return np.maximum(certainty, 1.0)


@dataclass(frozen=True, eq=False)
class _RefinementStep:
    solution: Array
    """Change of the free parameters, then the extras' coefficients."""
    parameters: int
    triangle: Array
    scale: Array
    linear: Linear
    levels: Levels
    troubles: Troubles


class _Problem:
    """Parts of the problem that are the same in every step."""

    def __init__(
        self,
        rows: SweepReadings,
        setting: Setting,
        fit: GlobalFit,
        priors: Mapping[str, Prior],
        extras: tuple[Extra, ...],
    ) -> None:
        self.rows, self.setting = rows, setting
        kinematics, readings = setting.arm, rows.readings
        self.arm, self.readings = kinematics, readings
        self.free = np.array([name in fit.names for name in parameter_names(kinematics)])
        self.mean, self.std = (values[self.free] for values in prior_vectors(kinematics.n, priors))
        self.row, self.joint = np.nonzero(readings.counted)
        count = len(self.row)
        self.columns = np.column_stack([np.zeros((count, 0)), *(extra.column[readings.counted] for extra in extras)])
        torque = float(np.abs(readings.torque[readings.counted]).max())
        sizes = torque / np.maximum(np.abs(self.columns).max(axis=0, initial=0.0), 1e-9)
        self.scale = np.concatenate([natural_units(kinematics, readings, fit.complete)[self.free], sizes])
        self.resolution = rows.resolution

    def step(self, vector: Array, factor: Array, level: Array) -> _RefinementStep:
        """Solve the problem linearised at a parameter vector (6n + 3,), noise times factor (n,)."""
        readings, free = self.readings, int(self.free.sum())
        modelled, jacobian, slope = predict_and_jacobian(self.arm, Parameters.from_vector(vector, self.arm.n), readings)
        lag = WITHIN * level[FAMILIES.index("direction")] * UNITS["direction"][0] * self.setting.rated[self.joint]
        own = self.rows.swept[self.row] == self.joint
        sigma = np.hypot(readings.sigma[readings.counted], np.where(own, 0.0, lag)) * factor[self.joint]
        rounding = _rounding_columns(readings, self.resolution, slope / sigma[:, None])
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
        linear = Linear(
            self.row,
            self.joint,
            sigma,
            precision - part @ part.T,
            residual,
            precision,
            design[:count, :free],
            random[:, rounding.shape[1] :],
        )
        triangle: Array = np.asarray(np.linalg.qr(rest, mode="r"), dtype=np.float64)
        return _RefinementStep(solution, free, triangle, self.scale, linear, levels, found)


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
