"""Which of several changes explains residuals: least squares of each, compared by BIC (docs/theory.md, section 6)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from gcomp.arrays import Array

DRIFT = ("gain", "offset", "drift")
"""Causes that are a drift of a torque sensor: of gain, of offset, or both."""


@dataclass(frozen=True, eq=False)
class ChangeHypothesis:
    """A change since the calibration, as what it does to the readings."""

    cause: str
    joint: int | None
    """Index of the joint; None if it concerns the whole arm."""
    columns: Array
    """Change of the K residuals per unit of each parameter (K, p)."""
    price: int | None = None
    """Parameters charged in the BIC; by default the number of columns."""

    @property
    def parameters(self) -> int:
        return self.columns.shape[1] if self.price is None else self.price


@dataclass(frozen=True, eq=False)
class ChangeFit:
    """Hypotheses fitted together."""

    hypothesis: ChangeHypothesis
    """The first of them."""
    bic: float
    chi2: float
    values: Array
    """Parameters of all of them (p,)."""
    covariance: Array
    """(p, p); 0 for parameters that the rows do not show."""
    shown: int
    """Number of independent parameters that the rows show."""


@dataclass(frozen=True)
class Verdict:
    """Result of one test. `values` and `covariance` are the parameters of the winning hypothesis."""

    cause: str
    """none, unknown, ambiguous, temperature (several zeros at once) or the winner's cause."""
    joint: int | None
    """Index of the joint, None if it concerns the whole arm."""
    confidence: float
    """Weight exp(−BIC/2) of the winner among all classes; for unknown and ambiguous that of the best hypothesis."""
    values: Array
    covariance: Array
    evidence: dict[str, float] = field(default_factory=dict)
    """BIC of the best of each class above the best one; `misfit` of the winner in standard deviations."""
    rivals: tuple[str, ...] = ()
    """Classes that fit as well, if ambiguous."""
    beside: int | None = None
    """Another joint whose sensor drifts at the same time."""

    @property
    def is_drift(self) -> bool:
        """Whether it is a drift of torque sensors, the only verdict that may lead to a new record."""
        return self.cause in DRIFT

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints concerned, the one with more evidence first."""
        return tuple(joint for joint in (self.joint, self.beside) if joint is not None)

    def other(self, joint: int) -> int | None:
        """The joint that drifts beside this one, if any."""
        return next((other for other in self.joints if other != joint), None)


class ResidualTest:
    """Residuals of K rows with what they have in common, and the hypotheses that may explain them."""

    def __init__(self, residual: Array, covariance: Array, hypotheses: Sequence[ChangeHypothesis]) -> None:
        """residual (K,), covariance (K, K) to expect of it where nothing has changed."""
        self.hypotheses = tuple(hypotheses)
        self._root = np.linalg.cholesky(covariance)
        white = self.whitened(np.column_stack([residual, *(each.columns for each in hypotheses)]))
        self.residual: Array = white[:, 0]
        """Whitened."""
        ends = np.cumsum([1, *(each.columns.shape[1] for each in hypotheses)])
        self.columns: list[Array] = [white[:, begin:end] for begin, end in pairwise(ends)]
        """Whitened, of each hypothesis."""
        self.chi2 = float(self.residual @ self.residual)
        """Where nothing has changed."""

    def whitened(self, columns: Array) -> Array:
        return np.linalg.solve(self._root, columns)  # scipy takes longer to load

    def index(self, cause: str, joint: int | None) -> int:
        """Number of a hypothesis; raises ValueError where there is none."""
        return [(each.cause, each.joint) for each in self.hypotheses].index((cause, joint))

    def fit(self, *indices: int) -> ChangeFit:
        columns = np.hstack([self.columns[index] for index in indices])
        return self.fit_columns([self.hypotheses[index] for index in indices], columns, self.residual)

    @staticmethod
    def fit_columns(together: Sequence[ChangeHypothesis], columns: Array, target: Array) -> ChangeFit:
        """Likewise with whitened columns (K, p) and a whitened target (K,) of their own."""
        u, s, vt, size = _decomposed(columns)
        kept = s > 0
        back = (vt[kept].T / s[kept]) / size[:, None]
        explained = u[:, kept].T @ target
        covariance, shown = back @ back.T, int(kept.sum())
        hidden = (np.abs(vt[~kept]) > 1e-3).any(axis=0)
        covariance[hidden] = covariance[:, hidden] = 0.0
        chi2 = float(target @ target) - float(explained @ explained)
        price = sum(each.parameters for each in together) - (columns.shape[1] - shown)
        bic = chi2 + price * float(np.log(len(target)))
        return ChangeFit(together[0], bic, chi2, back @ explained, covariance, shown)

    def misfit(self, chi2: float, parameters: int, doubt: float) -> float:
        """χ² above its degrees of freedom, in standard deviations; `doubt`: relative variance of what is expected."""
        free = max(len(self.residual) - parameters, 1)
        return round(float((chi2 - free) / np.sqrt(2 * free * (1 + doubt))), 2)

    def noticed(self, index: int, rivals: Iterable[int], needed: float) -> float:
        """Size of a hypothesis' change that wins in one case of two by a BIC of `needed`: over none, and all rivals."""
        bases = ((self._bases[rival], self.hypotheses[rival].parameters) for rival in rivals)
        return smallest_noticed_change(self.columns[index][:, 0], bases, needed)

    @cached_property
    def _bases(self) -> list[Array]:
        return [span(columns) for columns in self.columns]


def span(columns: Array) -> Array:
    """An orthonormal basis (K, r) of whitened columns (K, p), of which r are independent."""
    u, s, _, _ = _decomposed(columns)
    return u[:, s > 0]


def _decomposed(columns: Array) -> tuple[Array, Array, Array, Array]:
    """u, s, vt of columns (K, p) in units of their lengths, and these; s is 0 where columns depend on others."""
    size = np.linalg.norm(columns, axis=0)
    size[size <= 1e-9] = 1.0
    u, s, vt = np.linalg.svd(columns / size, full_matrices=False)
    return u, np.where(s > max(1e-6 * s[0], 1e-12), s, 0.0), vt, size


def smallest_noticed_change(own: Array, rivals: Iterable[tuple[Array, int]], evidence: float) -> float:
    """Size of a change with whitened column (K,) that wins in one case of two: over "none", and over every rival.

    Of each rival an orthonormal basis (K, p) and the parameters charged in its BIC.
    """
    size, once = float(own @ own), float(np.log(len(own)))
    needed = evidence + once
    for basis, price in rivals if size > 0 else ():
        alike = float(((basis.T @ own) ** 2).sum()) / size
        needed = max(needed, (evidence - (price - 1) * once) / max(1 - alike, 1e-9))
    return float(np.sqrt(needed / max(size, 1e-30)))
