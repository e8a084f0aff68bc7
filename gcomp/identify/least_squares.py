"""Weighted nonlinear least squares of the sensor model: Levenberg-Marquardt on a QR factor built block by block."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array
from gcomp.identify.identifiability import Information, Spectrum, analyse
from gcomp.identify.parameters import GAIN_STD, POSITION_GAIN_STD, Parameters, Prior, free_mask, prior_vectors
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict, predict_and_jacobian

BLOCK_ROWS = 192
"""Rows per update. A factorisation this small stays in the cache and on one thread; from 384 rows LAPACK uses threads,
which on a busy machine is ten to a hundred times slower."""
MAX_ITERATIONS = 60
"""Fits of sweeps take 3 or 4, hardly determined ones some 20."""
SETTLED, STALLED, EXACT = 1e-7, 1e-5, 1e-16
"""Converged if a step can lower the cost by less than the first share of it (a hundredth of that with fixed weights, as
convergence is then quadratic), or if no step lowers it and the gain expected is below the second share. The third is
the cost per reading that is rounding alone. Choices: far below the cost's own scatter of √(2/dof)."""


@dataclass(frozen=True, eq=False)
class LeastSquaresProblem:
    """A least-squares problem; vectors have the length of the whole parameter vector (6n + 3,)."""

    arm: Arm
    readings: StaticReadings
    free: Mask
    prior_mean: Array
    prior_std: Array
    position_sigma: Array
    unit: Array
    """Natural units of the parameters (`natural_units`)."""

    @classmethod
    def of(
        cls,
        arm: Arm,
        readings: StaticReadings,
        unknown: Collection[str],
        priors: Mapping[str, Prior],
        position_sigma: ArrayLike,
        unit: Array,
    ) -> "LeastSquaresProblem":
        """Check and convert to vectors; raises BadArray on an unknown family and on wrong shapes."""
        noise = as_array("position_sigma", np.broadcast_to(position_sigma, (arm.n,)), (arm.n,))
        mean, std = prior_vectors(arm.n, priors)
        return cls(arm, readings, free_mask(arm.n, unknown), mean, std, noise, unit)

    def near(self, guess: Parameters) -> "LeastSquaresProblem":
        """With a prior about `guess` on gains that have none."""
        gain = Prior(guess.gain, GAIN_STD * np.abs(guess.gain))
        usual = {"gain": gain, "position_gain": Prior(guess.position_gain, POSITION_GAIN_STD)}
        mean, std = prior_vectors(self.arm.n, usual)
        given = np.isfinite(self.prior_std)
        return replace(
            self, prior_mean=np.where(given, self.prior_mean, mean), prior_std=np.where(given, self.prior_std, std)
        )

    @property
    def reweighted(self) -> bool:
        """Whether the weights depend on the parameters."""
        return bool(self.position_sigma.any())

    def cost(self, vector: Array, weight: list[Array]) -> float:
        """Weighted sum of squares (priors included) at a parameter vector, with the weights of each block."""
        parameters = Parameters.from_vector(vector, self.arm.n)
        total = float(np.sum(self._prior_residual(vector) ** 2))
        for block, block_weight in zip(self.readings.blocks(), weight, strict=True):
            residual = (block.torque - predict(self.arm, parameters, block))[block.counted]
            total += float(np.sum((residual * block_weight) ** 2))
        return total

    def weights(self, vector: Array) -> list[Array]:
        """Weight of each counted reading, block by block: 1/σ with position noise."""
        parameters, weights = Parameters.from_vector(vector, self.arm.n), []
        for block in self.readings.blocks():
            variance = block.sigma[block.counted] ** 2
            if not self.reweighted:
                weights.append(1 / np.sqrt(variance))
                continue
            _, _, slope = predict_and_jacobian(self.arm, parameters, block)
            weights.append(1 / np.sqrt(variance + np.sum((slope * self.position_sigma) ** 2, axis=1)))
        return weights

    def _prior_residual(self, vector: Array) -> Array:
        return ((self.prior_mean - vector) / self.prior_std)[self.free]

    def factor(self, vector: Array, weight: list[Array]) -> tuple[Array, Array]:
        """(R (p, p), Qᵀr (p,)) of the weighted Jacobian and residual, priors included."""
        parameters, size = Parameters.from_vector(vector, self.arm.n), int(self.free.sum())
        prior = np.diag(1 / self.prior_std[self.free])
        triangle = np.column_stack([prior, self._prior_residual(vector)])
        for block, block_weight in zip(self.readings.blocks(), weight, strict=True):
            modelled, jacobian, _ = predict_and_jacobian(self.arm, parameters, block)
            residual = block.torque[block.counted] - modelled
            rows = np.column_stack([jacobian[:, self.free], residual]) * block_weight[:, None]
            triangle = fold(triangle, rows)
        square = np.zeros((size, size + 1))
        square[: min(size, len(triangle))] = triangle[:size]
        return square[:, :size], square[:, size]


@dataclass(frozen=True, eq=False)
class Outcome:
    vector: Array
    information: Information
    cost: float
    chi2: float
    dof: int
    converged: bool


def solve(problem: LeastSquaresProblem, first: Parameters) -> Outcome:
    """Minimise from `first`; no step goes along directions that the readings do not determine."""
    vector, damping, converged = first.vector, 0.0, False
    weight = problem.weights(vector)
    cost = problem.cost(vector, weight)
    for _ in range(MAX_ITERATIONS):
        if converged:
            break
        triangle, target = problem.factor(vector, weight)
        spectrum = Spectrum.of(triangle, problem.unit[problem.free])
        along = spectrum.left.T @ target
        gain = float(along @ along)
        converged = gain <= (SETTLED if problem.reweighted else SETTLED / 100) * cost or cost <= EXACT * sum(
            map(len, weight)
        )
        trial, trial_cost, damping = _step(problem, vector, weight, cost, spectrum, along, damping)
        if trial is None:
            converged = converged or gain <= STALLED * cost
            break
        vector, cost = trial, trial_cost
        if problem.reweighted:
            weight = problem.weights(vector)
            cost = problem.cost(vector, weight)
    information = analyse(problem.factor(vector, weight)[0], problem.unit[problem.free])
    parameters = Parameters.from_vector(vector, problem.arm.n)
    blocks = problem.readings.blocks()
    residual = [(block.torque - predict(problem.arm, parameters, block))[block.counted] for block in blocks]
    scaled = np.concatenate(residual) * np.concatenate(weight)
    dof = len(scaled) - information.rank
    return Outcome(vector, information, cost, float(scaled @ scaled), dof, converged)


def _step(
    problem: LeastSquaresProblem,
    vector: Array,
    weight: list[Array],
    cost: float,
    spectrum: Spectrum,
    along: Array,
    damping: float,
) -> tuple[Array | None, float, float]:
    """(Vector with a lower cost or None, its cost, damping for the next step)."""
    weakest = float(spectrum.values.min(initial=np.inf)) ** 2
    for _ in range(12):
        shrunk = along * spectrum.values / (spectrum.values**2 + damping)
        trial = vector.copy()
        trial[problem.free] += problem.unit[problem.free] * (spectrum.right.T @ shrunk)
        trial_cost = problem.cost(trial, weight)
        if trial_cost < cost:
            return trial, trial_cost, damping / 10 if damping > 1e-3 * weakest else 0.0
        damping = max(10 * damping, 0.1 * weakest)
    return None, cost, damping


def fold(triangle: Array, rows: Array) -> Array:
    """Triangular factor (p, p) of all rows folded in before and of the rows (K, p), in little memory."""
    for begin in range(0, len(rows), BLOCK_ROWS):
        stacked = np.vstack([triangle, rows[begin : begin + BLOCK_ROWS]])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
    return triangle


def linear_least_squares(blocks: Iterable[Array], unit: Array, rcond: float) -> Array:
    """The x (p,) that solves A x = b, of least norm in units (p,); rows [A | b] come in blocks.

    A direction with less than `rcond` of the largest singular value in those units is left at zero.
    """
    triangle = np.zeros((0, len(unit) + 1))
    for rows in blocks:
        triangle = fold(triangle, rows)
    return np.asarray(unit * np.linalg.lstsq(triangle[:, :-1] * unit, triangle[:, -1], rcond=rcond)[0])
