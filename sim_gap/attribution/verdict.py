"""The verdict: whether there is a gap, whether it is explained, and whether by one effect only."""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.confidence import founded
from sim_gap.attribution.diagnosis import Cause, Verdict
from sim_gap.residuals.layout import Row
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square

EXPLAINED = 0.15
"""Largest remaining share of the squared gap above the noise in an explained diagnosis."""


def row_rms(data: ResidualSet, left: dict[Row, Array] | None = None) -> dict[Row, float]:
    """RMS of each row with valid samples [N·m]; of `left` if given, else of the raw residual."""
    values = data.values if left is None else left
    return {row: root_mean_square(values[row][data.valid[row]]) for row in data.rows if data.valid[row].any()}


def is_quiet(data: ResidualSet) -> bool:
    """Whether noise alone could explain every row."""
    return all(rms <= data.quiet_threshold[row] for row, rms in row_rms(data).items())


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


def verdict(found: Sequence[Cause], data: ResidualSet, left: dict[Row, Array]) -> Verdict:
    """`unexplained` if a gap remains or no cause is well founded, `ambiguous` if the first cause has a rival."""
    after = row_rms(data, left)
    quiet = all(rms <= data.margin[row] for row, rms in after.items())
    if not found:
        return "no_gap" if quiet else "unexplained"
    if not quiet and share_left(data, left) > EXPLAINED:
        return "unexplained"
    if found[0].confounded_with:
        return "ambiguous"
    return "explained" if any(founded(cause.signs) for cause in found) else "unexplained"
