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

from calib.fit.calibration import NOISE_ROUNDS, USUAL_ROWS
from calib.fit.sweep_readings import FEWEST
from calib.motion.static_reading import StaticReading, stack
from calib.observer.cause_test import INEXACT
from calib.observer.config import LONGEST_WINDOW
from calib.observer.decision import AGREEMENT, DriftFinding, Event, verdict_evidence
from calib.observer.evidence import ChangeTest, DetectionLimits
from calib.observer.motor_belief import MotorBelief, PassageDetector, read_passages, save_passages
from calib.observer.saved_values import UNREADABLE
from calib.observer.tracking import Estimate
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, as_array
from gcomp.estimate.explanation import ChangeFit, ChangeHypothesis, ResidualTest, distance
from gcomp.identify.motor_model import family_slices


class MotionTest(ChangeTest):
    """The candidates fitted to K rows of motion."""

    most_misfit = 8.0
    """120 rows then scatter by 1.4 times what was learned. Friction of a joint is never quite what it was; a contact is
    far beyond."""
    sensor_std = 10 * ChangeTest.sensor_std

    def __init__(self, belief: MotorBelief, passages: Sequence[StaticReading]) -> None:
        """Rows after those that the belief rests on."""
        self._belief, self._passages = belief, passages
        residual, jacobian, covariance = belief.linearised(passages)
        found = ResidualTest(residual, covariance, _candidates(belief, jacobian, stack(passages, "joint")))
        super().__init__(found, len(passages) / (len(belief.learnt) + USUAL_ROWS), INEXACT)

    def denies(self, cause: str, joint: int | None, values: Array) -> bool:
        """Whether these rows show that an earlier change of these values is there no more."""
        if not values.size or cause == "unknown":
            return True  # it had no size
        own = self.found.places.get((cause, joint))
        if own is None:
            return False
        fit = self.fit(own)
        return distance(fit.values - values, fit.covariance) > AGREEMENT + 2 * fit.shown

    def fit(self, *indices: int) -> ChangeFit:
        """A payload is linearised again at the load found: friction goes with torque, whose sign a load may turn."""
        fit, own = super().fit(*indices), self.found.hypotheses[indices[0]]
        for _ in range(NOISE_ROUNDS if own.cause == "payload" else 0):
            arm, values = self._belief.arm, fit.values
            per_unit = np.column_stack(payload_columns(arm))
            residual, jacobian, _ = self._belief.linearised(self._passages, per_unit @ values)
            columns = jacobian[:, family_slices(arm.n)["beta"]] @ per_unit
            white = self.found.whitened(np.column_stack([residual, columns]))
            change = self.found.fit_columns([own], white[:, 1:], white[:, 0])
            fit = replace(change, values=values + change.values)
        return fit


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


REFERENCE = 360
"""Rows without a change that the belief is learned from: four minutes of creeping."""
LONGEST = 2 * LONGEST_WINDOW
"""Rows of a test at most: the latest. There is one after each LONGEST_WINDOW rows: of seven joints that creep in turn,
40 s."""
AGREEING = 2
"""Tests in a row that must say the same until it is an event."""
UNEXPLAINED = 3
"""The same of tests that nothing explains: the first ones after a change have rows of before it."""
SCHEMA = "moving/1"


class MovingObserver:
    """`handle(sample)` → events; `estimate()`; see `calib.observer.observer.Observer`."""

    def __init__(self, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated_torque: Array) -> None:
        """Against records of creep sweeps; rated_torque (n,) [N·m]."""
        self.arm, self._angle = arm, calibration.angle
        self._detector = PassageDetector(arm.n)
        self._belief = MotorBelief(arm, calibration, gravity, np.asarray(rated_torque, dtype=float))
        self._block: list[StaticReading] = []
        self._recent: list[StaticReading] = []
        self._count = np.zeros(arm.n, dtype=int)
        self._agreeing: tuple[str, int | None] = ("none", None)
        self._reported: tuple[str, int | None, Array] = ("none", None, np.empty(0))
        """Cause, joint and parameters of the newest verdict that was an event."""
        self._blocks = 0
        self._tested: tuple[int, MotionTest] | None = None

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

    def handle_row(self, passage: StaticReading) -> list[Event]:
        """Take one row, with true angles."""
        self._count += np.arange(self.arm.n) == passage.joint
        self._block.append(passage)
        if len(self._block) < LONGEST_WINDOW:
            return []
        block, self._block = self._block, []
        self._recent = (self._recent + block)[-LONGEST:]
        test = MotionTest(self._belief, self._recent)
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
        test, n = self._test(), self.arm.n
        nothing = np.zeros(2), np.diag(MotionTest.sensor_std**2)
        found = [nothing if test is None else test.sensor(j) for j in range(n)]
        change, covariance = (np.array(each) for each in zip(*found, strict=True))
        return Estimate.of(change, covariance, self._count)

    def limits(self) -> DetectionLimits:
        """The changes of each joint that would be noticed now, by motion like the latest; NaN where it tells none."""
        test, n = self._test(), self.arm.n
        if test is None:
            return DetectionLimits(np.full(n, np.nan), np.full(n, np.nan), LONGEST + LONGEST_WINDOW)
        return test.limits(n, LONGEST + LONGEST_WINDOW)

    def model_torque(self, position: Array) -> Array:
        torque = self._belief.gravity_torque(np.atleast_2d(self._angle(position)))
        return torque.reshape(position.shape)

    def install(self, finding: DriftFinding) -> None:
        """Another calibration is in force: rows before it no longer count."""
        self._block, self._recent, self._blocks = [], [], 0

    def save(self) -> dict[str, Any]:
        """The rows that the belief rests on, and those since, as JSON values."""
        rows = {"learnt": self._belief.learnt, "block": self._block, "recent": self._recent}
        saved: dict[str, Any] = {name: save_passages(some) for name, some in rows.items()}
        cause, joint, values = self._reported
        return {"schema": SCHEMA, "count": self._count.tolist(), "reported": [cause, joint, values.tolist()], **saved}

    def restore(self, values: dict[str, Any]) -> bool:
        n = self.arm.n
        try:
            if values["schema"] != SCHEMA:
                return False
            learnt, block, recent = (read_passages(values[name], n) for name in ("learnt", "block", "recent"))
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

    def _test(self) -> MotionTest | None:
        """The test of the latest rows; None while there are too few."""
        rows = (self._recent + self._block)[-LONGEST:]
        if len(rows) < LONGEST_WINDOW // 2:
            return None
        if self._tested is None or self._tested[0] != self.rows:
            self._tested = (self.rows, MotionTest(self._belief, rows))
        return self._tested[1]
