"""Confidence of a cause, and the verdict: whether there is a gap, whether it is explained, and by one effect only.

The confidence is a logistic regression on a cause's signs, fitted to blind cases, half with the effect withheld. The
weights come from tests/campaigns/gap_confidence.py; docs/diagnosing-a-gap.md lists the seeds of `armlink gap bench`
that they were fitted to and the calibration on another seed.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import HINT, Cause, Signs, Verdict
from sim_gap.residuals.layout import Row
from sim_gap.residuals.residual_set import EXPLAINED, ResidualSet, row_rms

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


def is_founded(signs: Signs, rivals: int = 0) -> bool:
    """Whether a cause accounts for the gap on its row, even if a general law or one of its rivals would too."""
    return confidence(replace(signs, outside=np.inf), min(rivals, 1)) >= FOUNDED


def features(signs: Signs) -> dict[str, float]:
    return {
        "evidence": float(np.log(np.clip(signs.evidence, 0.003, 3.0))),
        "left": float(np.log(np.clip(signs.left, 1e-3, 1.0))),
        "elsewhere": float(np.clip(signs.elsewhere, 0.0, 0.5)),
        "outside": float(np.log(np.clip(signs.outside, -BETTER, WORSE) + 0.1)),
    }


NEAR, ROW_LEFT = 2.0, 0.15
"""Most that may remain of a row: this many times its margin, or this share of its RMS."""


def is_within(data: ResidualSet) -> bool:
    """Whether noise, and what every arm has, could explain every row."""
    return all(rms <= data.margin[row] for row, rms in row_rms(data).items())


def share_left(data: ResidualSet, left: dict[Row, Array]) -> float:
    """Remaining share of the squared gap above the noise, over the rows with a gap, each with the same weight."""
    before, after = row_rms(data), row_rms(data, left)
    shares, weights = [], []
    for row, rms in before.items():
        floor = data.floor[row]
        if max(rms, after[row]) > data.margin[row]:
            scale = max(rms, after[row]) ** 2
            shares.append(max(after[row] ** 2 - floor**2, 0.0) / scale)
            weights.append(max(rms**2 - floor**2, 0.0) / scale)
    return float(min(np.sum(shares) / max(np.sum(weights), 1e-9), 1.0)) if shares else 0.0


def is_closed(data: ResidualSet, left: dict[Row, Array]) -> bool:
    """Whether the gap is closed: what remains is a small share of its RMS, and near the noise in every row."""
    before, after = row_rms(data), row_rms(data, left)
    near = all(rms <= max(NEAR * data.margin[row], ROW_LEFT * before[row]) for row, rms in after.items())
    return near and float(np.sqrt(share_left(data, left))) <= EXPLAINED


def carries(cause: Cause, found: Sequence[Cause]) -> bool:
    """Whether a cause carries the explanation: without it, more of what the most important one takes off is lost than
    an explanation may leave."""
    return cause.fall >= EXPLAINED * max(each.fall for each in found)


def verdict(
    found: Sequence[Cause], sets: Sequence[tuple[ResidualSet, dict[Row, Array]]], *, unsettled: bool = False
) -> Verdict:
    """The verdict from the causes and the held-out and training sets with what remains of them, held-out first.

    `unexplained` if a gap remains in either, no cause is well founded, or there is none while something beside the
    comparison is `unsettled`; `ambiguous` if the first cause has a rival, or one that carries the rest is a hint only.
    """
    data, left = sets[0]
    near = 1.0 if found else NEAR  # what an explanation may leave is no gap of the model that it was written into
    quiet = all(rms <= near * data.margin[row] for row, rms in row_rms(data, left).items())
    if not found:
        return "no_gap" if quiet and not unsettled else "unexplained"
    if not (quiet or is_closed(data, left)) or not all(is_closed(*each) for each in sets[1:]):
        return "unexplained"
    if not any(is_founded(cause.signs, len(cause.confounded_with)) for cause in found):
        return "unexplained"
    weak = any(cause.confidence < HINT and carries(cause, found) for cause in found)
    return "ambiguous" if weak or found[0].confounded_with else "explained"
