"""Gauss-Newton steps: fit the terms, evaluate their columns about the fit, fit again until both agree.

Derivatives are kept from one step to the next while the steps shrink; the prediction itself is always exact.
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.feasibility import pins
from sim_gap.search.normal_equations import NormalEquations
from sim_gap.search.stepwise_search import StepwiseSearch
from sim_gap.search.term import Term

AGREED = 5e-3
"""Largest change of a row's prediction by a step, as a share of the residual beside it and the relevance floor."""
WORSE = 1e-3
"""Increase of the score from which a step is halved."""
SLOW = 0.5
"""Change of a step, as a share of the last one's, from which derivatives are evaluated again."""

Values = dict[Term, Array]


def converge(
    nominal: ColumnStore, terms: Sequence[Term], start: Values | None = None
) -> tuple[ColumnStore, list[Term]]:
    """Columns of the terms about their own coefficients (`values` of the store), and the terms that remain plausible.

    `nominal` has the columns about the nominal model. `start` holds coefficients to begin with; without it the first
    step is about the nominal model.
    """
    terms = [term.start for term in terms]
    values = {term: c for term, c in (start or {}).items() if term in terms}
    best, kept, held, last = np.inf, values, Values(), np.inf
    arm = nominal.data.signals[0].arm
    slopes: ColumnStore | None = None
    for _ in range(10):  # steps at most
        store = nominal.at(values, slopes=slopes)
        search = StepwiseSearch(NormalEquations(store, terms), terms)
        now = score(store, values, search.normal)
        halved = 0
        while values and now > best + WORSE and halved < 3:
            values = {t: 0.5 * (c + kept.get(t, 0.0 * c)) for t, c in values.items()}
            store = nominal.at(values, slopes=slopes)
            search = StepwiseSearch(NormalEquations(store, terms), terms)
            now, halved = score(store, values, search.normal), halved + 1
        if values:
            best, kept, slopes = now, values, slopes or store
        held = pins(search, arm)
        if held:
            search.normal.pin(held)
            search.reweigh()
        terms, values = _step(search)
        if kept and set(terms) == set(kept):
            change = _change(search, kept, values)
            if change <= AGREED:
                break
            slopes = None if change > SLOW * last or halved else slopes
            last = change
    return nominal.at(values, {term: c for term, c in held.items() if term in values}), terms


def _step(search: StepwiseSearch) -> tuple[list[Term], Values]:
    """The terms of a fit, nonlinear ones at the size fitted, and their coefficients."""
    index, coefficients = search.weighted.fit(search.active)
    whole = np.zeros(search.normal.size)
    whole[index] = coefficients
    terms, values = [], {}
    for term in search.active:
        c = whole[search.normal.at[term]]
        new = term if term.form.signature.moves is not None else term.relinearised(c)
        if new != term and term.form.signature.offset is None:  # a secant over its own size
            c = np.ones_like(c)
        terms.append(new)
        values[new] = c
    return terms, values


def score(store: ColumnStore, values: Values, normal: NormalEquations) -> float:
    """Σ ½ log(R² + floor²) over the rows with the exact prediction of the estimate."""
    if not values:
        return float("inf")
    data = store.data
    squares = np.zeros(len(normal.rows))
    for r, row in enumerate(normal.rows):
        rest, valid = data.values[row].copy(), data.valid[row]
        for term, c in values.items():
            if row in (columns := store.columns(term)):
                rest -= columns[row] @ c
                if beside := store.offset(term):
                    rest -= beside[row][:, 0]
        squares[r] = np.mean(rest[valid] ** 2) if valid.any() else 0.0
    return float(0.5 * np.log(squares + normal.floor**2)[normal.seen].sum())


def _change(search: StepwiseSearch, old: Values, new: Values) -> float:
    """Largest change of a row's prediction by a step, as a share of the residual beside it and the relevance floor."""
    normal = search.normal
    change = np.zeros(normal.size)
    for term, c in new.items():
        change[normal.at[term]] = c - old[term]
    left = normal.mean_square(*search.weighted.fit(search.active)) + normal.floor**2
    return float(np.sqrt(np.max((normal.power(change) / left)[normal.seen], initial=0.0)))
