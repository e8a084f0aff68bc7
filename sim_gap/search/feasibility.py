"""Bodies that can exist: inertial parameters of links, constrained within a fit that would have them otherwise.

A fit of a link's inertia may want a body that no distribution of mass has. Then the coefficients are those of the least
increase of the weighted squares for which one has: the link's pseudo-inertia matrix stays positive definite. All other
coefficients are fitted to that.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.link import pseudo_inertia
from sim_gap.model.rigid_body import RigidArm
from sim_gap.search.estimate_signals import inertial_change
from sim_gap.search.term import Term
from sim_gap.search.term_equations import TermEquations

BARRIER_WEIGHTS = (1e-1, 1e-2, 1e-3, 1e-4)
"""Weights of −log det in turn, in units of the squares that the constraint costs at the start."""
NEWTON_STEPS = 25
"""Most Newton steps at each weight."""
SLOPE_STEP = 1e-6
"""Step of the differences in a coefficient, as a share of it."""
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
    """The coefficients closest to those wanted for which the matrix is positive, by Newton steps with a barrier."""
    x = 0.0 * wanted
    for share in np.linspace(0.95, 0.0, 20):
        if _positive(matrix(share * wanted)):
            x = 0.95 * share * wanted
            break
    cost = 0.5 * float((x - wanted) @ curvature @ (x - wanted))

    def value(at: Array, weight: float) -> float:
        if not _positive(matrix(at)):
            return float("inf")
        barrier = weight * float(np.linalg.slogdet(matrix(at))[1])
        return 0.5 * float((at - wanted) @ curvature @ (at - wanted)) - barrier

    for barrier in BARRIER_WEIGHTS:
        weight = barrier * max(cost, 1e-12)
        for _ in range(NEWTON_STEPS):
            inverse = np.linalg.inv(matrix(x))
            steps = SLOPE_STEP * np.maximum(np.abs(x), 1e-3)
            parts = [
                inverse @ (matrix(x + d) - matrix(x - d)) / (2 * s) for s, d in zip(steps, np.diag(steps), strict=True)
            ]
            slope = curvature @ (x - wanted) - weight * np.array([np.trace(part) for part in parts])
            bend = curvature + weight * np.array([[np.trace(a @ b) for b in parts] for a in parts])
            move = np.linalg.lstsq(bend, slope, rcond=1e-14)[0]
            now, length = value(x, weight), 1.0
            while length > 1e-4 and value(x - length * move, weight) >= now:
                length *= 0.5
            if length <= 1e-4:
                break
            x = x - length * move
    return x
