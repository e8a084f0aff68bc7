"""How often a cause with these signs is right: a logistic fit to blind cases, half of them with the effect withheld.

The weights come from tests/campaigns/gap_confidence.py; docs/diagnosing-a-gap.md says which seeds of `armlink gap
bench` they were fitted to, and how they did on another.
"""

from dataclasses import replace

import numpy as np

from sim_gap.attribution.diagnosis import Signs

WEIGHTS = {"constant": -3.37, "evidence": 0.42, "left": -0.87, "elsewhere": -2.9, "outside": 1.3}
"""Of 1 and of each feature."""
MOST = 0.99
FOUNDED = 0.3
"""Where no cause reaches this, laws outside the library apart, what is there is unexplained."""
BETTER, WORSE = 0.07, 0.9
"""A law outside the library that does better or worse by more than this tells no more."""
HINT = 0.5
"""Confidence of a cause in an answer that leaves structure unexplained is no more than this."""


def confidence(signs: Signs, rivals: int) -> float:
    """Probability that a cause is right; shared with its rivals where this recording cannot tell them apart.

    With rivals there is no evidence for one of them: the other signs speak for all of them together.
    """
    x = features(replace(signs, evidence=np.inf) if rivals else signs)
    odds = WEIGHTS["constant"] + sum(WEIGHTS[name] * value for name, value in x.items())
    sure = min(1.0 / (1.0 + float(np.exp(-odds))), MOST)
    return min(sure, 1.0 / (1 + rivals) + 0.2) if rivals else sure


def founded(signs: Signs) -> bool:
    """Whether a cause accounts for what it is named for, whatever else might."""
    return confidence(replace(signs, outside=np.inf), 0) >= FOUNDED


def features(signs: Signs) -> dict[str, float]:
    """The signs as the logistic fit takes them."""
    return {
        "evidence": float(np.log(np.clip(signs.evidence, 0.003, 3.0))),
        "left": float(np.log(np.clip(signs.left, 1e-3, 1.0))),
        "elsewhere": float(np.clip(signs.elsewhere, 0.0, 0.5)),
        "outside": float(np.log(np.clip(signs.outside, -BETTER, WORSE) + 0.1)),
    }
