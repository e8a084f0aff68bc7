"""Which change since the calibration explains rows of motion: a gain, an offset, friction, a payload, or nothing.

Generalised least squares of each candidate's columns, with the belief's own doubt in the covariance; candidates compete
by BIC, as in the test at rest (docs/theory.md, section 6).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.fit.calibration import VERY_STRONG_EVIDENCE
from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD, NOISE_ROWS
from calib.observer.decision import AGREEMENT
from calib.observer.evidence import ChangeFit, ChangeHypothesis, ResidualTest, Verdict
from calib.observer.motion.belief import MotorBelief
from calib.observer.motion.passages import Passage
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.estimate.posterior import linear_posterior
from gcomp.identify.motor_model import family_slices

LEAST_ROWS = 6
"""Rows of a joint from which a change of its drive can be told."""
MISFIT = 8.0
"""χ² above its degrees of freedom, in standard deviations, from which nothing explains the rows: 120 rows then scatter
by 1.4 times what was learned. Friction of a joint is never quite what it was; a contact is far beyond."""
INEXACT = 0.03
"""Most that a change's own shape may be off, as a share."""
PAYLOAD_ROUNDS = 2
"""Further linearisations of a payload."""

UNSEEN_STD = 10 * np.array([INITIAL_GAIN_STD, INITIAL_OFFSET_STD])
"""Standard deviations of a joint's gain and offset [N·m] where rows of motion tell nothing; a choice."""


class ChangeTest:
    """The candidates fitted to K rows."""

    def __init__(self, belief: MotorBelief, passages: Sequence[Passage]) -> None:
        """Rows after those that the belief rests on."""
        self._belief, self._passages = belief, passages
        residual, jacobian, covariance = belief.linearised(passages)
        joint = np.array([each.joint for each in passages])
        self.found = ResidualTest(residual, covariance, _candidates(belief, jacobian, joint))

    def verdict(self) -> Verdict:
        """The change that explains the rows; cause "none", "unknown" or "ambiguous" where no single one does."""
        fits = sorted(map(self._fit, range(len(self.found.hypotheses))), key=lambda fit: fit.bic)
        nothing = np.empty(0)
        none = Verdict("none", None, 1.0, nothing, np.empty((0, 0)), {"misfit": self._misfit(self.found.chi2, 0)})
        if not fits or self.found.chi2 - fits[0].bic < VERY_STRONG_EVIDENCE:
            return none if self._misfit(self.found.chi2, 0) <= MISFIT else _with_cause(none, "unknown")
        best, others = fits[0], fits[1:]
        scores = np.array([fit.bic for fit in fits] + [self.found.chi2])
        weight = np.exp(-(scores - best.bic) / 2)
        nearest = others[0].bic - best.bic if others else np.inf
        evidence = {"none": round(self.found.chi2 - best.bic, 1), "next": round(float(nearest), 1)}
        inexact = INEXACT**2 * (self.found.chi2 - best.chi2)
        evidence["misfit"] = self._misfit(best.chi2 - inexact, len(best.values))
        values, covariance = best.values, best.covariance
        cause, joint = best.hypothesis.cause, best.hypothesis.joint
        found = Verdict(cause, joint, float(1 / weight.sum()), values, covariance, evidence)
        if evidence["misfit"] > MISFIT or (cause == "payload" and values[0] < 0):
            return _with_cause(found, "unknown")
        rivals = [fit.hypothesis for fit in others if fit.bic - best.bic < VERY_STRONG_EVIDENCE]
        if rivals:
            return _with_cause(found, "ambiguous", tuple(each.cause for each in rivals))
        return found

    def denies(self, cause: str, joint: int | None, values: Array) -> bool:
        """Whether these rows show that an earlier change of these values is there no more."""
        own = self._index(cause, joint)
        if own is None:
            return False
        fit = self._fit(own)
        known = np.diag(fit.covariance) > 0
        away = (fit.values - values)[known]
        apart = float(away @ np.linalg.pinv(fit.covariance[np.ix_(known, known)]) @ away)
        return bool(apart > AGREEMENT + 2 * known.sum())

    def sensor(self, joint: int) -> tuple[Array, Array]:
        """Change of a joint's gain and offset (2,) [1, N·m], fitted together, and their covariance (2, 2).

        Drawn towards nothing where the rows tell little.
        """
        places = [self._index(cause, joint) for cause in ("gain", "offset")]
        columns = [self.found.columns[place] for place in places if place is not None]
        if not columns:
            return np.zeros(2), np.diag(UNSEEN_STD**2)
        fit = linear_posterior(np.hstack(columns), self.found.residual, np.zeros(2), UNSEEN_STD)
        return fit.x, fit.covariance

    def noticed(self, cause: str, joint: int) -> float:
        """Size of a change that is noticed in one case of two by as many rows: over "none", and over every rival."""
        own = self._index(cause, joint)
        if own is None:
            return float("nan")
        rivals = [k for k in range(len(self.found.hypotheses)) if k != own]
        return self.found.noticed(own, rivals, VERY_STRONG_EVIDENCE)

    def _index(self, cause: str, joint: int | None) -> int | None:
        known = [(each.cause, each.joint) for each in self.found.hypotheses]
        return known.index((cause, joint)) if (cause, joint) in known else None

    def _fit(self, index: int) -> ChangeFit:
        """A payload is linearised again at the load found: friction goes with torque, whose sign a load may turn."""
        fit, own = self.found.fit(index), self.found.hypotheses[index]
        for _ in range(PAYLOAD_ROUNDS if own.cause == "payload" else 0):
            arm, values = self._belief.arm, fit.values
            per_unit = np.column_stack(payload_columns(arm))
            residual, jacobian, _ = self._belief.linearised(self._passages, per_unit @ values)
            columns = jacobian[:, family_slices(arm.n)["beta"]] @ per_unit
            white = self.found.whitened(np.column_stack([residual, columns]))
            change = self.found.fit_columns([own], white[:, 1:], white[:, 0])
            fit = replace(change, values=values + change.values)
        return fit

    def _misfit(self, chi2: float, parameters: int) -> float:
        known = len(self._belief.learnt) + NOISE_ROWS
        return self.found.misfit(chi2, parameters, (len(self._passages) - parameters) / known)


def _candidates(belief: MotorBelief, jacobian: Array, joint: Array) -> list[ChangeHypothesis]:
    n, at = belief.arm.n, family_slices(belief.arm.n)
    found = []
    coulomb, load = belief.mean[at["coulomb"]], belief.mean[at["load"]]
    uneven = np.arange(at["uneven"].start, at["uneven"].stop).reshape(n, -1)
    for j in range(n):
        if (joint == j).sum() < LEAST_ROWS:
            continue
        column = {name: jacobian[:, at[name].start + j] for name in ("gain", "offset", "coulomb", "load")}
        friction = coulomb[j] * column["coulomb"] + load[j] * column["load"]
        friction = friction + jacobian[:, uneven[j]] @ belief.mean[uneven[j]]
        for cause, each in (("gain", column["gain"]), ("offset", column["offset"]), ("friction", friction)):
            if np.abs(each).max() > 1e-9:
                found.append(ChangeHypothesis(cause, j, each[:, None]))
    payload = jacobian[:, at["beta"]] @ np.column_stack(payload_columns(belief.arm))
    if np.abs(payload).max() > 1e-9:
        found.append(ChangeHypothesis("payload", None, payload))
    return found


def _with_cause(verdict: Verdict, cause: str, rivals: tuple[str, ...] = ()) -> Verdict:
    joint = verdict.joint if cause == "ambiguous" else None
    return Verdict(cause, joint, verdict.confidence, verdict.values, verdict.covariance, verdict.evidence, rivals)
