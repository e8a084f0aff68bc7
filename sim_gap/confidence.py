"""How often a cause with these signs is right: a logistic fit to blind cases, half of them with the effect withheld.

The numbers come from `armlink gap bench`; docs/diagnosing-a-gap.md says which seeds, and how they did on others.
"""

import numpy as np

from sim_gap.diagnosis import Signs

WEIGHTS = {"constant": -3.9, "evidence": 0.3, "left": -1.1, "elsewhere": -3.0}
"""Of 1, log evidence, log left, and what is left elsewhere; fitted, evidence and the rest by hand, for the cases that
were right hardly lack any."""
MOST = 0.99
FOUNDED = 0.35
"""Where no cause reaches this, what is there is unexplained."""
HINT = 0.5
"""Confidence of a cause in an answer that leaves structure unexplained is no more than this."""


def confidence(signs: Signs, rivals: int) -> float:
    """Probability that a cause is right; shared with its rivals where this recording cannot tell them apart."""
    x = features(signs)
    odds = WEIGHTS["constant"] + sum(WEIGHTS[name] * value for name, value in x.items())
    sure = min(1.0 / (1.0 + float(np.exp(-odds))), MOST)
    return min(sure, 1.0 / (1 + rivals) + 0.2) if rivals else sure


def features(signs: Signs) -> dict[str, float]:
    """The signs as the logistic fit takes them."""
    return {
        "evidence": float(np.log(np.clip(signs.evidence, 0.003, 3.0))),
        "left": float(np.log(np.clip(signs.left, 1e-3, 1.0))),
        "elsewhere": float(np.clip(signs.elsewhere, 0.0, 0.5)),
    }
