"""Gauss-Newton steps: fit the terms, evaluate their columns about the fit, fit again until both agree.

A fit of a link's inertia may want a body that no distribution of mass has. Then the coefficients are those of the least
increase of the weighted squares for which one has: the link's pseudo-inertia matrix stays positive definite. All other
coefficients are fitted to that.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from gcomp.arm.inertials import pseudo_inertia
from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array
from gcomp.estimate.choice import AS_GOOD
from sim_gap.search.column_store import ColumnStore, inertial_change
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermEquations

LEAST_EIGENVALUE = 1e-6
"""Least eigenvalue of a pseudo-inertia, as a share of its trace."""

Matrix = Callable[[Array], Array]


def pins(equations: TermEquations, arm: RigidArm) -> dict[Term, Array]:
    """Coefficients of the terms that a fit would give to links that cannot exist, at the closest that can."""
    every = equations.index(equations.terms).tolist()
    linear = equations.linear.reweighed(every)
    change = linear.fit(every)
    values = {term: change[at] for term, at in equations.at.items()}
    out: dict[Term, Array] = {}
    for link in range(arm.n):
        own = [term for term in values if _shapes(term, link, arm.n)]
        if not own:
            continue
        start = np.concatenate([values[term] for term in own])
        matrix = _matrix(arm, link, own, values)
        if _positive(matrix(start)) or not _positive(matrix(0.0 * start)):
            continue
        at = np.concatenate([equations.at[term] for term in own])
        best = _closest(start, linear.curvature(at, every), matrix)
        for term in own:
            width = len(equations.at[term])
            out[term], best = best[:width], best[width:]
    return out


def _shapes(term: Term, link: int, n: int) -> bool:
    """Whether a term may give this link an impossible shape."""
    return (term.effect, term.place) == ("link.inertia", link) or (term.effect == "link.payload" and link == n - 1)


def _matrix(arm: RigidArm, link: int, own: Sequence[Term], values: Mapping[Term, Array]) -> Matrix:
    """The link's pseudo-inertia as a function of the coefficients of its own terms."""
    others = [term for term in values if term not in own and term.place == link and term.effect.startswith("link.")]

    def matrix(x: Array) -> Array:
        inertial = arm.inertial.copy()
        for term in others:
            inertial[link] += _link_change(term, values[term], inertial)
        first = 0
        for term in own:
            width = len(values[term])
            inertial[link] += _link_change(term, x[first : first + width], inertial)
            first += width
        return pseudo_inertia(inertial[link])

    return matrix


def _link_change(term: Term, c: Array, inertial: Array) -> Array:
    number = term.bound[0] if term.bound else 0
    change = inertial_change(term, c, inertial, number)
    return np.zeros(10) if change is None else change


def _positive(matrix: Array) -> bool:
    return bool(np.linalg.eigvalsh(matrix).min() > LEAST_EIGENVALUE * max(float(np.trace(matrix)), 0.0))


def _closest(wanted: Array, curvature: Array, matrix: Matrix) -> Array:
    """The coefficients closest to those wanted, by the increase of the weighted squares, whose matrix is positive."""
    size = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    scaled, aim = curvature / size / size[:, None], size * wanted

    def above_least(x: Array) -> Array:
        now = matrix(x / size)
        least = 2.0 * LEAST_EIGENVALUE * max(float(np.trace(now)), 0.0)
        return np.asarray((np.linalg.eigvalsh(now) - least) / np.trace(matrix(0.0 * x)))

    start = _farthest(0.0 * wanted, 0.95 * wanted, matrix)
    found = minimize(
        lambda x: 0.5 * (x - aim) @ scaled @ (x - aim),
        size * start,
        jac=lambda x: scaled @ (x - aim),
        constraints={"type": "ineq", "fun": above_least},
        method="SLSQP",
    )
    return _farthest(start, found.x / size, matrix)  # SLSQP may end outside


def _farthest(inside: Array, end: Array, matrix: Matrix) -> Array:
    """The point nearest to the end, on the way there from one whose matrix is positive, at which it still is."""
    ways = (inside + share * (end - inside) for share in np.linspace(1.0, 0.0, 20))
    return next(x for x in ways if _positive(matrix(x)))


AGREED = 5e-3
"""Largest change of a row's prediction by a step, as a share of the residual beside it and the relevance floor."""
STEPS, HALVINGS = 10, 3
"""Most steps, and most halvings of one."""

Values = dict[Term, Array]


def converge(
    nominal: ColumnStore, terms: Sequence[Term], start: Values | None = None
) -> tuple[ColumnStore, list[Term]]:
    """Columns of the terms about their own coefficients (`values` of the store), and the terms at their final shapes;
    from the coefficients `start` on, or from the nominal model, which `nominal` has the columns about."""
    terms = [term.start for term in terms]
    values = {term: c for term, c in (start or {}).items() if term in terms}
    best, kept, held = np.inf, values, Values()
    arm = nominal.data.signals[0].arm
    for _ in range(STEPS):
        equations = TermEquations(nominal.at(values), terms)
        now = score(equations, values)
        halved = 0
        while values and now > best + AS_GOOD and halved < HALVINGS:
            values = {t: 0.5 * (c + kept.get(t, 0.0 * c)) for t, c in values.items()}
            equations = TermEquations(nominal.at(values), terms)
            now, halved = score(equations, values), halved + 1
        if values:
            best, kept = now, values
        held = pins(equations, arm)
        if held:
            equations = TermEquations(nominal.at(values, held), terms)
        found = equations.fitted()
        terms, values = relinearised_at(found)
        if kept and set(terms) == set(kept) and _change(equations, kept, found) <= AGREED:
            break
    return nominal.at(values, {term: c for term, c in held.items() if term in values}), terms


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
    return equations.log_squares(change)


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
    left = linear.mean_squares(after) + linear.floor**2
    return float(np.sqrt(np.max((power / left)[equations.seen], initial=0.0)))
