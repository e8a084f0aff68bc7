"""The change since the calibration, by the residuals of a window of rows (docs/theory.md, section 6).

Rows at rest (`cause_test.py`) and of motion (`moving_observer.py`) have hypotheses of their own; the test is the same.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calib.fit.calibration import VERY_STRONG_EVIDENCE
from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD
from gcomp.arrays import Array
from gcomp.estimate.explanation import ChangeFit, ChangeHypothesis, ResidualTest
from gcomp.estimate.posterior import linear_posterior

DRIFT = ("gain", "offset", "drift")
"""Causes that are a drift of a torque sensor: of gain, of offset, or both."""
MOST_GAIN_LIMIT = 1.0
"""A gain whose limit is above this is not observed: gravity hardly loads the joint."""


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


@dataclass(frozen=True)
class DetectionLimits:
    """Smallest changes that are noticed, in one case of two; 1.5 times as large ones almost always."""

    gain: Array
    """Relative (n,); NaN if gravity does not load the joint."""
    offset: Array
    """(n,) [N·m]."""
    rests: int
    """Rests at other poses, or rows of motion, after which they are noticed."""


class ChangeTest:
    """Residuals of a window of rows, and the single change that explains them, if any."""

    most_misfit: ClassVar[float]
    """(χ² − dof)/√(2 dof) above which a change does not explain the rows."""
    sensor_std: ClassVar[Array] = np.array([INITIAL_GAIN_STD, INITIAL_OFFSET_STD])
    """Standard deviations of a change of gain and offset [1, N·m] before the rows."""

    def __init__(self, found: ResidualTest, doubt: float, inexact: float) -> None:
        """doubt: relative variance of the covariance expected; inexact: most that an effect's own shape may be off, as
        a share."""
        self.found, self._doubt, self._inexact = found, doubt, inexact

    def verdict(self) -> Verdict:
        """The winning class, or why none wins: cause "none", "unknown" or "ambiguous"."""
        fits = sorted(map(self.fit, range(len(self.found.hypotheses))), key=lambda fit: fit.bic)
        classes = {"none": self.found.chi2}
        for fit in reversed(fits):
            classes[self.class_of(fit.hypothesis)] = fit.bic
        top = min(classes.values())
        weights = {name: np.exp(-(bic - top) / 2) for name, bic in classes.items()}
        nearest = sorted(classes.items(), key=lambda item: item[1])[:6]
        evidence = {name: round(float(bic - top), 1) for name, bic in nearest}

        def answer(cause: str, fit: ChangeFit | None, of: str, rivals: tuple[str, ...] = ()) -> Verdict:
            known = (fit.values, fit.covariance) if fit else (np.empty(0), np.empty((0, 0)))
            joint = fit.hypothesis.joint if fit else None
            return Verdict(cause, joint, float(weights[of] / sum(weights.values())), *known, evidence, rivals)

        if not fits or self.found.chi2 - fits[0].bic < VERY_STRONG_EVIDENCE:
            evidence["misfit"] = self.misfit(self.found.chi2, 0)
            return answer("unknown" if evidence["misfit"] > self.most_misfit else "none", None, "none")
        best, winner, name = fits[0], fits[0].hypothesis, self.class_of(fits[0].hypothesis)
        inexact = self._inexact**2 * (self.found.chi2 - best.chi2)
        evidence["misfit"] = self.misfit(best.chi2 - inexact, winner.columns.shape[1])
        if evidence["misfit"] > self.most_misfit or not self.is_possible(best):
            return self.several_changes() or answer("unknown", None, name)
        near = [fit.hypothesis for fit in fits[1:] if fit.bic - best.bic < VERY_STRONG_EVIDENCE]
        if self.is_of_the_arm(best, near):
            return answer("none", None, "none")
        rivals = tuple(dict.fromkeys(self.class_of(entry) for entry in near if not self.kin(entry, winner)))
        return answer("ambiguous" if rivals else winner.cause, best, name, rivals)

    def fit(self, *indices: int) -> ChangeFit:
        """Generalised least squares of hypotheses together."""
        return self.found.fit(*indices)

    def class_of(self, entry: ChangeHypothesis) -> str:
        """Class of an entry in the comparison of verdicts."""
        return entry.cause if entry.joint is None else f"{entry.cause}_{entry.joint + 1}"

    def kin(self, entry: ChangeHypothesis, winner: ChangeHypothesis) -> bool:
        """Whether an entry is not a rival of the winner."""
        return self.class_of(entry) == self.class_of(winner)

    def is_possible(self, best: ChangeFit) -> bool:
        """Whether a change can have the size found: a payload has a mass."""
        return best.hypothesis.cause != "payload" or bool(best.values[0] > 0)

    def is_of_the_arm(self, best: ChangeFit, near: list[ChangeHypothesis]) -> bool:
        """Whether an effect is no larger than what the arm has anyway; `near` fit nearly as well."""
        return False

    def several_changes(self) -> Verdict | None:
        """Two or more changes that explain the rows where no single one does; None if none do."""
        return None

    def misfit(self, chi2: float, parameters: int) -> float:
        return self.found.misfit(chi2, parameters, self._doubt)

    def sensor(self, joint: int) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,), drawn towards nothing where rows tell little; its covariance."""
        places = [self.found.places.get((cause, joint)) for cause in ("gain", "offset")]
        told = [at for at, place in enumerate(places) if place is not None]
        change, covariance = np.zeros(2), np.diag(self.sensor_std**2)
        if told:
            columns = np.hstack([self.found.columns[place] for place in places if place is not None])
            fit = linear_posterior(columns, self.found.residual, np.zeros(len(told)), self.sensor_std[told])
            change[told], covariance[np.ix_(told, told)] = fit.x, fit.covariance
        return change, covariance

    def noticed(self, cause: str, joint: int) -> float:
        """Size of a change that wins in one case of two: over "none", and over every rival; NaN where no row tells."""
        index, entries = self.found.places.get((cause, joint)), self.found.hypotheses
        if index is None:
            return float("nan")
        rivals = [k for k, entry in enumerate(entries) if not self.kin(entry, entries[index])]
        return self.found.noticed(index, rivals, VERY_STRONG_EVIDENCE)

    def limits(self, n: int, rests: int, longer: float = 1.0) -> DetectionLimits:
        """Limits of n joints in work like that of the rows, by a window `longer` than theirs."""
        gain, offset = (
            np.array([self.noticed(cause, j) for j in range(n)]) / np.sqrt(longer) for cause in ("gain", "offset")
        )
        gain[~(gain <= MOST_GAIN_LIMIT)] = np.nan
        return DetectionLimits(gain, offset, rests)
