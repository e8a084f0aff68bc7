"""Steadiness of a cause: whether it shows in most blocks of the held-out data and not in a few moments."""

from collections.abc import Sequence

import numpy as np

from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import Estimate
from sim_gap.search.term import Term

STEADY = 2.0
"""Least mean decrease of a row's sum of squares over the blocks, in standard errors."""


def steadiness(estimate: Estimate, heldout: ResidualSet, terms: Sequence[Term]) -> float:
    """Decrease of some held-out row's sum of squares by these terms, all others fitted, in standard errors.

    The mean over blocks of time of the decrease per block, divided by the standard error of that mean; the largest of
    the rows.
    """
    store = estimate.on(heldout)
    with_them = estimate.subset(list(estimate.terms))
    without = estimate.subset([term for term in estimate.terms if term not in terms])
    best = 0.0
    for row in heldout.rows:
        valid = heldout.valid[row]
        touching = [term for term in estimate.terms if row in store.columns(term)]
        if not valid.any() or not any(row in store.columns(term) for term in terms):
            continue
        columns = store.wide(touching, row, estimate.normal.fixed)[valid]
        index = estimate.normal.index(touching)
        left, more = (heldout.values[row][valid] - columns @ c[index] for c in (with_them, without))
        falls = np.bincount(heldout.blocks[valid], more**2 - left**2)
        falls = falls[np.unique(heldout.blocks[valid])]
        if len(falls) > 2:
            best = max(best, float(falls.mean() / (falls.std(ddof=1) / np.sqrt(len(falls)) + 1e-300)))
    return best
