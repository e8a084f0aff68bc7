"""Levels of random effects by restricted maximum likelihood (docs/theory.md, 4.6)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from gcomp.arrays import Array

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
    rest: float
    """Sum of squares that parameters and nuisances leave."""
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
        rest = float(target @ target - along @ taken[:, -1])
        return cls(
            effects.T @ effects - across.T @ taken[:, :-1],
            effects.T @ target[: len(effects)] - across.T @ taken[:, -1],
            rest,
            family,
            families,
        )


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels found."""

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
