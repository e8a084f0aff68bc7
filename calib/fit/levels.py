"""Levels of random effects by restricted maximum likelihood (docs/theory.md, 4.6)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from gcomp.arrays import Array

ROUNDS = 40
SETTLED = 0.02
"""Largest relative change of a level at which the iteration ends."""
LEAST, WEIGHT, FEW = 0.1, 2.0, 5.0
"""Beforehand a level is the arm's common one, at least LEAST, and that is worth WEIGHT coefficients: an arm is good or
bad in all that it is, and a family that hardly shows keeps a level instead of none, which would make the intervals
certain of what the readings do not tell. The common level is the mean of the logarithms, in which a family counts as
much as it has coefficients that the readings tell, and at most FEW."""

LARGEST = 5.0
"""Largest level: bad arms have 3. A trouble that asks for more is not small: it stands out, is named and taken out."""


@dataclass(frozen=True, eq=False)
class Effects:
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
    def of(cls, fixed: Array, effects: Array, target: Array, family: npt.NDArray[np.int64], families: int) -> "Effects":
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
    criterion: float
    """Twice the negative restricted log-likelihood, up to a constant."""


def learn(effects: Effects, start: Array) -> Levels:
    """Levels of all families (F,) by MacKay's iteration from `start`; a family without effects keeps its start."""
    level, freedom = start.copy(), np.zeros(effects.families)
    places = [np.flatnonzero(effects.family == family) for family in range(effects.families)]
    criterion = np.inf
    for _ in range(ROUNDS):
        spread, solution, criterion = _solved(effects, level)
        before, counts = level.copy(), np.clip(freedom, 0.1, FEW)
        common = max(LEAST, float(np.exp(counts @ np.log(level) / counts.sum())))
        for family, at in enumerate(places):
            if len(at):
                freedom[family] = len(at) - spread[at].sum() / level[family] ** 2
                told = solution[at] @ solution[at] + WEIGHT * common**2
                level[family] = min(np.sqrt(told / (max(freedom[family], 0.0) + WEIGHT)), LARGEST)
        if np.abs(level / before - 1).max() < SETTLED:
            break
    return Levels(level, freedom, criterion)


def _solved(effects: Effects, level: Array) -> tuple[Array, Array, float]:
    """(Variances of the effects, their values, criterion)."""
    of_each = level[effects.family]
    square = of_each[:, None] * effects.square * of_each
    square[np.diag_indices_from(square)] += 1.0
    root = np.asarray(linalg.cholesky(square, lower=True, check_finite=False))
    inverse, _ = linalg.lapack.dtrtri(root, lower=1)
    whitened = inverse @ (of_each * effects.right)
    spread = of_each**2 * np.einsum("ij,ij->j", inverse, inverse)
    solution: Array = of_each * (inverse.T @ whitened)
    size = 2 * np.log(np.diag(root)).sum()
    return spread, solution, float(effects.rest - whitened @ whitened + size)
