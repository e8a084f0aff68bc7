"""Confidence of a cause: a logistic regression on its signs, fitted to blind cases, half with the effect withheld.

The weights come from tests/campaigns/gap_confidence.py; docs/diagnosing-a-gap.md lists the seeds of `armlink gap bench`
that they were fitted to and the calibration on another seed.
"""

from dataclasses import replace

import numpy as np

from sim_gap.attribution.diagnosis import Signs

WEIGHTS = {"constant": -3.37, "evidence": 0.42, "left": -0.87, "elsewhere": -2.9, "outside": 1.3}
"""Weights of the constant and of each feature."""
MOST = 0.99
"""Largest confidence."""
FOUNDED = 0.3
"""If no cause reaches this confidence, general laws disregarded, the gap is unexplained."""
BETTER, WORSE = 0.07, 0.9
"""Bounds of the feature `outside`: a general law that fits better or worse than this carries no more information."""


def confidence(signs: Signs, rivals: int) -> float:
    """Probability that a cause is right; shared with rivals that these recordings cannot separate.

    With rivals the evidence is none for either: the other signs hold for all of them together.
    """
    x = features(replace(signs, evidence=np.inf) if rivals else signs)
    odds = WEIGHTS["constant"] + sum(WEIGHTS[name] * value for name, value in x.items())
    sure = min(1.0 / (1.0 + float(np.exp(-odds))), MOST)
    return min(sure, 1.0 / (1 + rivals) + 0.2) if rivals else sure


def founded(signs: Signs, rivals: int = 0) -> bool:
    """Whether a cause accounts for the gap on its row, even if a general law or one of its rivals would too."""
    return confidence(replace(signs, outside=np.inf), min(rivals, 1)) >= FOUNDED


def features(signs: Signs) -> dict[str, float]:
    """The signs as features of the logistic regression."""
    return {
        "evidence": float(np.log(np.clip(signs.evidence, 0.003, 3.0))),
        "left": float(np.log(np.clip(signs.left, 1e-3, 1.0))),
        "elsewhere": float(np.clip(signs.elsewhere, 0.0, 0.5)),
        "outside": float(np.log(np.clip(signs.outside, -BETTER, WORSE) + 0.1)),
    }
