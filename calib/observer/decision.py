"""From a drift verdict to a finding that may be written: the rules at the end of docs/theory.md, section 6; events."""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from armlink.torque_calibration import TorqueCalibration
from calib.fit.calibration import SIGNIFICANCE, VERY_STRONG_EVIDENCE
from calib.observer.cause_test import AGREEMENT, CauseTest
from calib.observer.config import ObserverConfig
from calib.observer.evidence import Verdict
from gcomp.arrays import Array
from gcomp.design.selection import MINIMUM_LEVER

COMMON_JOINTS = 3
"""If this many joints drift by the same factor, suspect gravity, payload or supply voltage, and write none
(likewise)."""
WIDER = 1.5
"""The variance of a finding is larger by this share where the model's error is all there is: level and shape of the
discrepancy are estimates. Without it the errors of 30 findings on arms of `sim.realism` had 2.5 times the variance."""


@dataclass(frozen=True)
class DriftFinding:
    """Change of one joint's sensor against the installed calibration, and the reasons against writing it, if any."""

    joint: int
    cause: str
    """gain, offset or drift (both)."""
    gain: float
    """Relative gain: 1 if it has not changed."""
    offset: float
    """[N·m], of the reading as installed."""
    covariance: Array
    """Of gain and offset (2, 2); 0 for what is not estimated."""
    rows: int
    confidence: float
    refused: tuple[str, ...] = ()

    @property
    def change(self) -> TorqueCalibration[float]:
        """Calibration of the drifted sensor: it reads gain · τ + offset instead of τ [N·m]."""
        return TorqueCalibration(self.gain, self.offset)

    @property
    def std(self) -> tuple[float, float]:
        """Standard deviations of gain and offset [N·m]."""
        gain, offset = np.sqrt(np.diag(self.covariance))
        return float(gain), float(offset)

    def as_json(self) -> dict[str, Any]:
        """JSON values, without the reasons for a refusal."""
        return {
            "joint": int(self.joint),
            "cause": self.cause,
            "gain": float(self.gain),
            "offset": float(self.offset),
            "rows": int(self.rows),
            "confidence": float(self.confidence),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Self:
        return cls(**{**values, "covariance": np.array(values["covariance"])})


def windows_agree(first: CauseTest, second: CauseTest, joint: int, beside: int | None) -> bool:
    """Whether two disjoint windows find the same gain and offset change of a joint: χ²₂ of the difference.

    If gravity does not load the joint, only the offset is compared. `beside`: a joint that drifts at the same time.
    """
    (a, cov_a), (b, cov_b) = (window.drift(joint, "drift", beside) for window in (first, second))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        (a, cov_a), (b, cov_b) = (window.drift(joint, "offset", beside) for window in (first, second))
        return bool((a - b)[1] ** 2 < AGREEMENT * (cov_a + cov_b)[1, 1])
    return float((a - b) @ np.linalg.solve(cov_a + cov_b, a - b)) < AGREEMENT


def decide(test: CauseTest, verdict: Verdict, joint: int, config: ObserverConfig) -> DriftFinding:
    """The finding for one joint of a drift verdict on all rows that agree, with every rule that forbids a write."""
    cause, refused = verdict.cause, []
    beside = verdict.other(joint)
    wider = 1 + WIDER * float(test.known.of_model[joint])
    change, covariance = test.drift(joint, cause, beside)
    weak_lever = test.lever_share(joint) < MINIMUM_LEVER
    # no worse than what the arm has anyway
    gain_std = float(np.hypot(config.gain_std, test.known.relative_level[joint]))
    offset_std = float(np.hypot(config.offset_std, test.known.level[joint]))
    if cause != "offset" and (weak_lever or covariance[0, 0] > gain_std**2):
        std = (
            f"the gain is known only to ± {np.sqrt(covariance[0, 0]):.2%}, but ± {gain_std:.2%} is required: "
            "more poses are needed in which gravity loads this joint"
        )
        if test.loss(joint, "offset", cause, beside) < VERY_STRONG_EVIDENCE:
            cause = "offset"  # explained as well without the gain, which keeps its value
            change, covariance = test.drift(joint, cause, beside)
        else:
            refused.append("gravity loads this joint too little to find a gain" if weak_lever else std)
    if covariance[1, 1] > offset_std**2:
        refused.append(
            f"the offset is known only to ± {np.sqrt(covariance[1, 1]):.3f} N·m, but ± {offset_std:.3g} N·m is required"
        )
    if _distance(change, covariance) < SIGNIFICANCE:
        refused.append(f"the change is less than {SIGNIFICANCE:g} standard deviations")
    if len(set(np.sign(test.window.direction[:, joint])) - {0.0}) < 2:
        refused.append("the joint was approached from one side only, so friction looks like an offset")
    alike = _joints_alike(test, joint)
    if alike >= COMMON_JOINTS:
        refused.append(
            f"{alike} joints changed by the same factor, so the cause may be gravity, a payload or the supply voltage"
        )
    moved = _moved_zeros(test, verdict, joint)
    if cause != "gain" and moved >= COMMON_JOINTS - 1:
        refused.append(f"the zeros of {moved} other joints moved as well, so the cause may be the temperature")
    gain, offset, rows = 1.0 + float(change[0]), float(change[1]), len(test.window.position)
    return DriftFinding(joint, cause, gain, offset, wider * covariance, rows, verdict.confidence, tuple(refused))


def _moved_zeros(test: CauseTest, verdict: Verdict, joint: int) -> int:
    """Number of joints beside those that drift whose offset has changed too."""
    changes = [test.drift(j, "offset", joint) for j in range(test.belief.arm.n) if j not in verdict.joints]
    return sum(bool(abs(change[1]) >= SIGNIFICANCE * np.sqrt(covariance[1, 1])) for change, covariance in changes)


def _distance(change: Array, covariance: Array) -> float:
    """Length of the change in standard deviations, over the parameters that were estimated."""
    estimated = np.diag(covariance) > 0
    part = change[estimated]
    return float(np.sqrt(part @ np.linalg.solve(covariance[np.ix_(estimated, estimated)], part)))


def _joints_alike(test: CauseTest, joint: int) -> int:
    """Number of joints that, each fitted alone, changed their gain by the same factor as this joint within noise."""
    fits = [test.drift(j, "gain") for j in range(test.belief.arm.n)]
    changes = np.array([change[0] for change, _ in fits])
    stds = np.array([np.sqrt(covariance[0, 0]) for _, covariance in fits])
    alike = (np.abs(changes) >= SIGNIFICANCE * stds) & (
        np.abs(changes - changes[joint]) <= 3 * np.hypot(stds, stds[joint])
    )
    return int(alike.sum())


@dataclass(frozen=True)
class Event:
    """One event. `kind`: alarm, verdict, proposal or undecided."""

    t: float
    kind: str
    joint: str | None
    evidence: dict[str, Any] = field(default_factory=dict)
    finding: DriftFinding | None = None
    """The change to write, for a proposal."""


def verdict_evidence(verdict: Verdict, names: tuple[str, ...]) -> dict[str, Any]:
    """A verdict as the evidence of an event: cause, confidence, BIC of the other classes, parameters.

    A payload has `mass` [kg] and `com`, its centre of mass in the last link's bar frame [m]; None if no lever shows it.
    """
    beside: dict[str, Any] = {} if verdict.beside is None else {"beside": names[verdict.beside]}
    if verdict.cause in ("payload", "tool"):  # parameters: mass and first moment
        mass, (shown, *told) = float(verdict.values[0]), (np.diag(verdict.covariance) > 0).tolist()
        known = [shown and each for each in told]
        place = [
            moment / mass if here else None for moment, here in zip(verdict.values[1:].tolist(), known, strict=True)
        ]
        beside = {"mass": mass if shown else None, "com": place}
    return {
        "cause": verdict.cause,
        **beside,
        "confidence": verdict.confidence,
        "bic": verdict.evidence,
        "values": verdict.values.tolist(),
        "std": np.sqrt(np.diag(verdict.covariance)).tolist(),
        "rivals": list(verdict.rivals),
    }
