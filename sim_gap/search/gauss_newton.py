"""Gauss-Newton steps: fit the terms, evaluate their columns about the fit, fit again until both agree.

Derivatives are kept from one step to the next while the steps shrink; the prediction itself is always exact.
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.feasibility import pins
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermEquations

AGREED = 5e-3
"""Largest change of a row's prediction by a step, as a share of the residual beside it and the relevance floor."""
WORSE = 1e-3
"""Increase of the score from which a step is halved."""
SLOW = 0.5
"""Change of a step, as a share of the last one's, from which derivatives are evaluated again."""
STEPS, HALVINGS = 10, 3
"""Most steps, and most halvings of one."""

Values = dict[Term, Array]


def converge(
    nominal: ColumnStore, terms: Sequence[Term], start: Values | None = None
) -> tuple[ColumnStore, list[Term]]:
    """Columns of the terms about their own coefficients (`values` of the store), and the terms at their final shapes.

    `nominal` has the columns about the nominal model. `start` holds coefficients to begin with; without it the first
    step is about the nominal model.
    """
    terms = [term.start for term in terms]
    values = {term: c for term, c in (start or {}).items() if term in terms}
    best, kept, held, last = np.inf, values, Values(), np.inf
    arm = nominal.data.signals[0].arm
    slopes: ColumnStore | None = None
    for _ in range(STEPS):
        equations = TermEquations(nominal.at(values, slopes=slopes), terms)
        now = score(equations, values)
        halved = 0
        while values and now > best + WORSE and halved < HALVINGS:
            values = {t: 0.5 * (c + kept.get(t, 0.0 * c)) for t, c in values.items()}
            equations = TermEquations(nominal.at(values, slopes=slopes), terms)
            now, halved = score(equations, values), halved + 1
        if values:
            best, kept, slopes = now, values, slopes or equations.store
        held = pins(equations, arm)
        if held:
            equations = TermEquations(nominal.at(values, held, slopes=slopes), terms)
        found = fitted(equations)
        terms, values = relinearised_at(found)
        if kept and set(terms) == set(kept):
            change = _change(equations, kept, found)
            if change <= AGREED:
                break
            slopes = None if change > SLOW * last or halved else slopes
            last = change
    return nominal.at(values, {term: c for term, c in held.items() if term in values}), terms


def fitted(equations: TermEquations) -> Values:
    """Coefficients of a fit of all terms, the rows weighed by what it leaves."""
    every = equations.index(equations.terms).tolist()
    change = equations.linear.reweighed(every).fit(every)
    return {term: change[at] for term, at in equations.at.items()}


def relinearised_at(found: Values) -> tuple[list[Term], Values]:
    """The terms of a fit, nonlinear ones at the size fitted, and their coefficients."""
    values = {}
    for term, c in found.items():
        new = term if term.form.signature.moves is not None else term.relinearised(c)
        if new != term and term.form.signature.offset is None:  # a secant over its own size
            c = np.ones_like(c)
        values[new] = c
    return list(values), values


def score(equations: TermEquations, values: Values) -> float:
    """Σ ½ log(R² + floor²) over the rows with the exact prediction of the estimate."""
    if not values:
        return float("inf")
    change = np.zeros(equations.size)
    for term, c in values.items():
        if term in equations.at:
            change[equations.at[term]] = c
    change[list(equations.fixed.values())] = 1.0
    squares = equations.mean_square(change)
    return float(0.5 * np.log(squares + equations.linear.floor**2)[equations.seen].sum())


def _change(equations: TermEquations, old: Values, new: Values) -> float:
    """Largest change of a row's prediction by a step, as a share of the residual beside it and the relevance floor."""
    before, after, moved = (np.zeros(equations.size) for _ in range(3))
    for term, at in equations.at.items():
        after[at], before[at] = new[term], old[term]
    moved = after - before
    linear = equations.linear
    after[list(equations.fixed.values())] = 1.0
    power = [moved[i] @ s.sum(0) @ moved[i] for i, s in zip(linear.acting, linear.squares, strict=True)]
    power = np.array(power) / np.maximum(linear.counts.sum(1), 1e-300)
    left = equations.mean_square(after) + linear.floor**2
    return float(np.sqrt(np.max((power / left)[equations.seen], initial=0.0)))
