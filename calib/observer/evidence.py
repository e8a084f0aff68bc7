"""Terms of a test of changes: residuals, hypotheses that may explain them, fits, verdicts."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gcomp.arrays import Array

DRIFT = ("gain", "offset", "drift")
"""Causes that are a drift of a torque sensor: of gain, of offset, or both."""
INEXACT = 0.02
"""Most that an effect's own shape may be off, as a share: it is as inexact as the gravity model's torque."""


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
    family: str | None = None
    """Causes of one joint that count as one in the comparison of verdicts; by default the cause alone."""
    about: Callable[[Array], tuple[Array, Array]] | None = None
    """(Residuals, columns) about values of the parameters, of a change that is not linear."""

    @property
    def parameters(self) -> int:
        return self.columns.shape[1] if self.price is None else self.price

    @property
    def class_name(self) -> str:
        """Of the class in the comparison of verdicts."""
        cause = self.family or self.cause
        return cause if self.joint is None else f"{cause}_{self.joint + 1}"


@dataclass(frozen=True, eq=False)
class Residuals:
    """Readings less what is expected of them where nothing has changed, and the changes that may be."""

    residual: Array
    """(K,) [N·m]."""
    covariance: Array
    """Of the residuals (K, K): noise, and what the model does not know."""
    hypotheses: Sequence[ChangeHypothesis]
    doubt: float
    """Relative variance of what χ² is expected to be: scatter and level are estimates."""
    of_model: Array
    """Share of the model's own error in the variance of each joint's residuals (n,)."""
    level: Array
    """Torque that the model lacks anyway (n,) [N·m]: effects of an arm up to this size are nothing new."""
    relative_level: Array
    """The same as a share of the torque (n,): changes' own shapes are as inexact, at most by `INEXACT`."""


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


def span(columns: Array) -> Array:
    """An orthonormal basis (K, r) of whitened columns (K, p), of which r are independent."""
    u, s, _, _ = decomposed(columns)
    return u[:, s > 0]


def decomposed(columns: Array) -> tuple[Array, Array, Array, Array]:
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
