"""Bodies that can exist: inertial parameters of links, constrained within a fit that would have them otherwise.

A fit of a link's inertia may want a body that no distribution of mass has. Then the coefficients are those of the least
increase of the weighted squares for which one has: the link's pseudo-inertia matrix stays positive definite. All other
coefficients are fitted to that.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from gcomp.arrays import Array
from sim_gap.effects.link import pseudo_inertia
from sim_gap.model.rigid_body import RigidArm
from sim_gap.search.estimate_signals import inertial_change
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
            inertial[link] += _change(term, values[term], inertial)
        first = 0
        for term in own:
            width = len(values[term])
            inertial[link] += _change(term, x[first : first + width], inertial)
            first += width
        return pseudo_inertia(inertial[link])

    return matrix


def _change(term: Term, c: Array, inertial: Array) -> Array:
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
