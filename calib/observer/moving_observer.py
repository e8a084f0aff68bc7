"""The observer of arms whose torque is a motor current: changed torque constants, friction and payloads, in motion.

Pure, as the observer of torque sensors (`calib.observer.observer`), with the same interface. It proposes no record: a
constant that has changed is measured again by creep sweeps.

Which change since the calibration explains rows of motion: a gain, an offset, friction, a payload, or nothing?
Generalised least squares of each candidate's columns, with the belief's own doubt in the covariance; candidates compete
by BIC, as in the test at rest (docs/theory.md, section 6). tests/campaigns/moving_arms.py bounds what the thresholds
here result in: changes found, changes not found, and none where there is none.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.fit.calibration import NOISE_ROUNDS, USUAL_ROWS, VERY_STRONG_EVIDENCE
from calib.fit.sweep_readings import FEWEST
from calib.observer.cause_test import INEXACT, DetectionLimits
from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD, LONGEST_WINDOW
from calib.observer.decision import AGREEMENT, DriftFinding, Event, verdict_evidence
from calib.observer.evidence import ChangeFit, ChangeHypothesis, ResidualTest, Verdict
from calib.observer.motor_belief import MotorBelief, Passage, PassageDetector
from calib.observer.saved_values import UNREADABLE
from calib.observer.tracking import Estimate
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, as_array
from gcomp.estimate.posterior import linear_posterior
from gcomp.identify.motor_model import family_slices

MISFIT = 8.0
"""χ² above its degrees of freedom, in standard deviations, from which nothing explains the rows: 120 rows then scatter
by 1.4 times what was learned. Friction of a joint is never quite what it was; a contact is far beyond."""

UNSEEN_STD = 10 * np.array([INITIAL_GAIN_STD, INITIAL_OFFSET_STD])
"""Standard deviations of a joint's gain and offset [N·m] where rows of motion tell nothing; a choice."""
NOTHING = np.zeros(2), np.diag(UNSEEN_STD**2)
"""Their change then, drawn to 0, and its covariance."""


class ChangeTest:
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
        misfit = self._misfit(self.found.chi2, 0)
        if not fits or self.found.chi2 - fits[0].bic < VERY_STRONG_EVIDENCE:
            cause = "none" if misfit <= MISFIT else "unknown"
            return Verdict(cause, None, 1.0, nothing, np.empty((0, 0)), {"misfit": misfit})
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
            return replace(found, cause="unknown", joint=None)
        rivals = tuple(fit.hypothesis.cause for fit in others if fit.bic - best.bic < VERY_STRONG_EVIDENCE)
        return replace(found, cause="ambiguous", rivals=rivals) if rivals else found

    def denies(self, cause: str, joint: int | None, values: Array) -> bool:
        """Whether these rows show that an earlier change of these values is there no more."""
        if not values.size or cause == "unknown":
            return True  # it had no size
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
            return NOTHING
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
        for _ in range(NOISE_ROUNDS if own.cause == "payload" else 0):
            arm, values = self._belief.arm, fit.values
            per_unit = np.column_stack(payload_columns(arm))
            residual, jacobian, _ = self._belief.linearised(self._passages, per_unit @ values)
            columns = jacobian[:, family_slices(arm.n)["beta"]] @ per_unit
            white = self.found.whitened(np.column_stack([residual, columns]))
            change = self.found.fit_columns([own], white[:, 1:], white[:, 0])
            fit = replace(change, values=values + change.values)
        return fit

    def _misfit(self, chi2: float, parameters: int) -> float:
        known = len(self._belief.learnt) + USUAL_ROWS
        return self.found.misfit(chi2, parameters, (len(self._passages) - parameters) / known)


def _candidates(belief: MotorBelief, jacobian: Array, joint: Array) -> list[ChangeHypothesis]:
    n, at = belief.arm.n, family_slices(belief.arm.n)
    found = []
    coulomb, load = belief.mean[at["coulomb"]], belief.mean[at["load"]]
    uneven = np.arange(at["uneven"].start, at["uneven"].stop).reshape(n, -1)
    for j in range(n):
        if (joint == j).sum() < FEWEST:
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


LONGEST = 2 * LONGEST_WINDOW
"""Rows of a test at most: the latest. There is one after each LONGEST_WINDOW rows: of seven joints that creep in turn,
40 s."""
REFERENCE = 3 * LONGEST
"""Rows without a change that the belief is learned from: four minutes of creeping."""
AGREEING = 2
"""Tests in a row that must say the same until it is an event."""
UNEXPLAINED = AGREEING + 1
"""The same of tests that nothing explains: the first ones after a change have rows of before it."""
SCHEMA = "moving/1"


class MovingObserver:
    """`handle(sample)` → events; `estimate()`; see `calib.observer.observer.Observer`."""

    def __init__(self, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated_torque: Array) -> None:
        """Against records of creep sweeps; rated_torque (n,) [N·m]."""
        self.arm = arm
        self._angle = calibration.angle
        self._detector = PassageDetector(arm.n)
        self._belief = MotorBelief(arm, calibration, gravity, np.asarray(rated_torque, dtype=float))
        self._block: list[Passage] = []
        self._recent: list[Passage] = []
        self._count = np.zeros(arm.n, dtype=int)
        self._agreeing: tuple[str, int | None] = ("none", None)
        self._reported: tuple[str, int | None, Array] = ("none", None, np.empty(0))
        """Cause, joint and parameters of the newest verdict that was an event."""
        self._blocks = 0
        self._tested: tuple[int, ChangeTest] | None = None

    @property
    def rows(self) -> int:
        return int(self._count.sum())

    @property
    def accepted(self) -> Array:
        return self._count.copy()

    @property
    def held(self) -> bool:
        """Estimates are never held: nothing is written by this observer."""
        return False

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Event]:
        events: list[Event] = []
        for passage in self._detector.handle(t, self._angle(position), torque, temperature):
            events += self.handle_row(passage)
        return events

    def handle_row(self, passage: Passage) -> list[Event]:
        self._count[passage.joint] += 1
        self._block.append(passage)
        if len(self._block) < LONGEST_WINDOW:
            return []
        block, self._block = self._block, []
        self._recent = (self._recent + block)[-LONGEST:]
        test = ChangeTest(self._belief, self._recent)
        verdict = test.verdict()
        if verdict.cause == "none" and not test.denies(*self._reported):
            return []  # these rows do not show the change that was found
        said = verdict.cause, verdict.joint
        self._blocks = self._blocks + 1 if said == self._agreeing else 1
        self._agreeing = said
        learning = len(self._belief.learnt) < REFERENCE
        if learning and (verdict.cause == "none" or (verdict.cause == "unknown" and self._blocks >= AGREEING)):
            self._belief, self._recent = self._belief.learn(self._recent), []  # unknown twice: the arm's own
        if verdict.cause == "ambiguous" or (learning and verdict.cause == "unknown"):
            return []  # more rows may decide
        enough = UNEXPLAINED if verdict.cause == "unknown" else AGREEING
        if self._blocks < enough or said == self._reported[:2]:
            return []
        self._reported = (*said, verdict.values)
        joint = None if verdict.joint is None else self.arm.names[verdict.joint]
        return [Event(passage.t, "verdict", joint, verdict_evidence(verdict, self.arm.names) | {"motor": True})]

    def estimate(self) -> Estimate:
        test = self._test()
        found = [NOTHING if test is None else test.sensor(j) for j in range(self.arm.n)]
        change, std = (np.array(each).T for each in zip(*((c, np.sqrt(np.diag(v))) for c, v in found), strict=True))
        return Estimate(1 + change[0], std[0], change[1], std[1], self._count.copy())

    def limits(self) -> DetectionLimits:
        """The changes of each joint that would be noticed now, by motion like the latest; NaN where it tells none."""
        test, n = self._test(), self.arm.n
        if test is None:
            return DetectionLimits(np.full(n, np.nan), np.full(n, np.nan), LONGEST + LONGEST_WINDOW)
        gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) for cause in ("gain", "offset"))
        return DetectionLimits(gain, offset, LONGEST + LONGEST_WINDOW)

    def model_torque(self, position: Array) -> Array:
        torque = self._belief.gravity_torque(np.atleast_2d(self._angle(position)))
        return torque.reshape(position.shape)

    def install(self, finding: DriftFinding) -> None:
        """Another calibration is in force: rows before it no longer count."""
        self._block, self._recent, self._blocks = [], [], 0

    def save(self) -> dict[str, Any]:
        """The rows that the belief rests on, and those since, as JSON values."""
        rows = {"learnt": self._belief.learnt, "block": self._block, "recent": self._recent}
        saved: dict[str, Any] = {name: [each.to_json() for each in some] for name, some in rows.items()}
        cause, joint, values = self._reported
        return {"schema": SCHEMA, "count": self._count.tolist(), "reported": [cause, joint, values.tolist()], **saved}

    def restore(self, values: dict[str, Any]) -> bool:
        n = self.arm.n
        try:
            if values["schema"] != SCHEMA:
                return False
            learnt, block, recent = (
                [Passage.from_json(each, n) for each in values[name]] for name in ("learnt", "block", "recent")
            )
            count = np.array(values["count"], dtype=int)
            cause, joint, size = values["reported"]
            reported = str(cause), joint, as_array("reported", np.array(size, dtype=float), (None,))
            if count.shape != (n,) or not (joint is None or 0 <= joint < n):
                return False
        except UNREADABLE:
            return False
        self._belief = self._belief.learn(learnt) if learnt else self._belief
        self._block, self._recent, self._count = block, recent, count
        self._reported, self._tested = reported, None
        return True

    def _test(self) -> ChangeTest | None:
        """The test of the latest rows; None while there are too few."""
        rows = (self._recent + self._block)[-LONGEST:]
        if len(rows) < LONGEST_WINDOW // 2:
            return None
        if self._tested is None or self._tested[0] != self.rows:
            self._tested = (self.rows, ChangeTest(self._belief, rows))
        return self._tested[1]
