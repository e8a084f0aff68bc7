"""The observer of arms whose torque is a motor current: changed torque constants, friction and payloads, in motion.

Pure, as the observer of torque sensors (`calib.observer.observer`), with the same interface. It proposes no record: a
constant that has changed is measured again by creep sweeps.

tests/campaigns/moving_arms.py bounds what the thresholds of this package result in: changes found, changes not found,
and none where there is none.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.observer.cause_test import DetectionLimits
from calib.observer.decision import DriftFinding
from calib.observer.events import Event, verdict_evidence
from calib.observer.motion.belief import MotorBelief
from calib.observer.motion.change_test import UNSEEN_STD, ChangeTest
from calib.observer.motion.passages import Passage, PassageDetector
from calib.observer.saved_values import UNREADABLE
from calib.observer.tracking.sensor_filter import Estimate
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array

BLOCK = 60
"""Rows of one test: of seven joints that creep in turn, 40 s."""
REFERENCE = 360
"""Rows without a change that the belief is learned from: four minutes of creeping."""
LONGEST = 2 * BLOCK
"""Rows of a test at most: the latest."""
AGREEING = 2
"""Tests in a row that must say the same until it is an event."""
UNEXPLAINED = 3
"""The same of tests that nothing explains: the first ones after a change have rows of before it."""
SCHEMA = "moving/1"


@dataclass(frozen=True, eq=False)
class Reported:
    """The newest verdict that was an event."""

    cause: str
    joint: int | None
    values: Array
    """Parameters of the change."""

    @property
    def is_change(self) -> bool:
        """Whether it is a change that has a size."""
        return bool(self.values.size) and self.cause != "unknown"


class MovingObserver:
    """`handle(sample)` → events; `estimate()`; see `calib.observer.observer.Observer`."""

    def __init__(self, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated_torque: Array) -> None:
        """Against records of creep sweeps; rated_torque (n,) [N·m]."""
        self.arm = arm
        self._position_gain = calibration.values("position_gain", 1.0)
        self._position_offset = calibration.values("position_offset", 0.0)
        self._detector = PassageDetector(arm.n)
        self._belief = MotorBelief(arm, calibration, gravity, np.asarray(rated_torque, dtype=float))
        self._block: list[Passage] = []
        self._recent: list[Passage] = []
        self._count = np.zeros(arm.n, dtype=int)
        self._agreeing: tuple[str, int | None] = ("none", None)
        self._reported = Reported("none", None, np.empty(0))
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
        """Take one row, with true angles."""
        self._count[passage.joint] += 1
        self._block.append(passage)
        if len(self._block) < BLOCK:
            return []
        block, self._block = self._block, []
        self._recent = (self._recent + block)[-LONGEST:]
        test = ChangeTest(self._belief, self._recent)
        verdict = test.verdict()
        if (
            verdict.cause == "none"
            and self._reported.is_change
            and not test.denies(self._reported.cause, self._reported.joint, self._reported.values)
        ):
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
        if self._blocks < enough or said == (self._reported.cause, self._reported.joint):
            return []
        self._reported = Reported(*said, verdict.values)
        joint = None if verdict.joint is None else self.arm.names[verdict.joint]
        return [Event(passage.t, "verdict", joint, verdict_evidence(verdict, self.arm.names) | {"motor": True})]

    def estimate(self) -> Estimate:
        """Gain and offset of every joint against the records, by the latest rows."""
        test = self._test()
        gain, offset = np.ones(self.arm.n), np.zeros(self.arm.n)
        std = np.tile(UNSEEN_STD[:, None], self.arm.n)
        for j in range(self.arm.n if test is not None else 0):
            assert test is not None
            change, covariance = test.sensor(j)
            gain[j], offset[j] = 1 + change[0], change[1]
            std[:, j] = np.sqrt(np.diag(covariance))
        return Estimate(gain, std[0], offset, std[1], self._count.copy())

    def limits(self) -> DetectionLimits:
        """The changes of each joint that would be noticed now, by motion like the latest; NaN where it tells none."""
        test, n = self._test(), self.arm.n
        if test is None:
            return DetectionLimits(np.full(n, np.nan), np.full(n, np.nan), LONGEST + BLOCK)
        gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) for cause in ("gain", "offset"))
        return DetectionLimits(gain, offset, LONGEST + BLOCK)

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
        reported = [self._reported.cause, self._reported.joint, self._reported.values.tolist()]
        return {"schema": SCHEMA, "count": self._count.tolist(), "reported": reported, **saved}

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
            reported = Reported(str(cause), joint, as_array("reported", np.array(size, dtype=float), (None,)))
            if count.shape != (n,) or not (joint is None or 0 <= joint < n):
                return False
        except UNREADABLE:
            return False
        self._belief = self._belief.learn(learnt) if learnt else self._belief
        self._block, self._recent, self._count = block, recent, count
        self._reported, self._tested = reported, None
        return True

    def _angle(self, position: Array) -> Array:
        return np.asarray(self._position_gain * position + self._position_offset)

    def _test(self) -> ChangeTest | None:
        """The test of the latest rows; None while there are too few."""
        rows = (self._recent + self._block)[-LONGEST:]
        if len(rows) < BLOCK // 2:
            return None
        if self._tested is None or self._tested[0] != self.rows:
            self._tested = (self.rows, ChangeTest(self._belief, rows))
        return self._tested[1]
