"""The observer's events."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.observer.decision import DriftFinding
from calib.observer.evidence import Verdict


@dataclass(frozen=True)
class Event:
    """One event. `kind`: alarm, outliers, verdict, proposal or undecided."""

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
