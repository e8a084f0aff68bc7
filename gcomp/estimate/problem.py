"""Residuals of measurements as a function of parameters, and their derivatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array

Index = NDArray[np.intp]
FREEDOM = 4.0
"""Degrees of freedom of Student's t (Lange, Little and Taylor, JASA 84, 1989)."""
CHEAPER_ERROR = 0.3
"""Relative difference of a derivative by the cheaper prediction up to which it serves: it leads to the same point, and
a step that is off by a third brings nine tenths of its fall."""
NORMAL = 1e6
"""Degrees of freedom from which Student's t is a normal distribution, to all digits that count."""


@dataclass(frozen=True)
class FittedParameter:
    """A number that a fit may change, in the coordinate in which it is fitted."""

    name: str
    nominal: float
    prior_std: float
    """Standard deviation about the nominal value before any measurement."""
    low: float = -np.inf
    high: float = np.inf
    channel: int = -1
    """The only channel that it acts on, as far as derivatives count; −1 if it acts on all."""
    step: float = 0.01
    """Step of a finite difference."""
    along: tuple[tuple[int, float], ...] = ()
    """Parameters that are changed with it in a difference, and by how much over its own change; their own derivatives
    are taken off again. The motion hardly depends on the common scale of all torques, and differences by one of them
    alone, which sticking and slipping roughen, do not add up to that."""


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """C channels of N rows each; K parameters."""

    parameters: tuple[FittedParameter, ...]
    predict: Callable[[Array], Array]
    """Parameters (P, K) → residuals (P, C, N)."""
    weight: Array
    """Number of independent measurements that each row counts for, (C, N)."""
    block: Index
    """Block of each row, (N,)."""
    floor: Array
    """Standard deviation below which a residual shows nothing, (C,)."""
    freedom: float = FREEDOM
    """Degrees of freedom of the residuals' distribution."""
    cheaper: Callable[[Array], Array] | None = None
    """A coarser prediction, for derivatives alone."""

    def within(self, theta: Array) -> Array:
        return np.clip(theta, [p.low for p in self.parameters], [p.high for p in self.parameters])

    @property
    def nominal(self) -> Array:
        return np.array([p.nominal for p in self.parameters])

    def changes(self, theta: Array, residual: Array, moved: Array) -> Array:
        """Residuals at points (P, K) beside `theta` less that there, (P, C, N): by the cheaper prediction, if the first
        is about as by the other one, each channel beside what is left of it."""
        if self.cheaper is None or len(moved) < 4:  # the cheaper one takes two by itself
            return self.predict(moved) - residual
        exact = self.predict(moved[:1]) - residual
        there, tried = self.cheaper(np.stack([theta, moved[0]]))
        left = (self.weight * (residual**2 + self.floor[:, None] ** 2)).sum(1, keepdims=True)
        share = self.weight / np.maximum(left, 1e-300)
        apart, size = (float((share * x**2).sum()) for x in (tried - there - exact[0], exact[0]))
        others = (
            self.cheaper(moved[1:]) - there if apart <= CHEAPER_ERROR**2 * size else self.predict(moved[1:]) - residual
        )
        return np.concatenate([exact, others])


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem about a point."""

    theta: Array
    residual: Array
    """(C, N)."""
    acting: tuple[Index, ...]
    """Numbers of the free parameters that act on each channel."""
    slopes: tuple[Array, ...]
    """Their derivatives there, (k, N) each."""


def linearise(
    problem: EstimationProblem, theta: Array, free: Sequence[int], residual: Array | None = None
) -> Linearised:
    """Derivatives by differences: one evaluation changes a parameter of each channel, for it acts there by far most.

    The residual is exact in any case, and given (C, N) where it is known; the derivatives lead to it.
    """
    own = [[k for k in free if problem.parameters[k].channel == c] for c in range(len(problem.weight))]
    shared = [k for k in free if problem.parameters[k].channel < 0]
    together = [[each[i] for each in own if i < len(each)] for i in range(max(map(len, own), default=0))]
    steps = np.array([p.step for p in problem.parameters])
    steps = np.where(theta + steps > [p.high for p in problem.parameters], -steps, steps)
    points = list[Array]()
    for some in (*together, *([k] for k in shared)):
        moved = theta.copy()
        moved[some] += steps[some]
        for k in some:
            for other, share in problem.parameters[k].along:
                moved[other] += share * steps[k]
        points.append(moved)
    residual = problem.predict(theta[None])[0] if residual is None else residual
    changes = problem.changes(theta, residual, np.stack(points)) if points else np.empty((0, *residual.shape))
    acting, slopes = [], []
    for c, each in enumerate(own):
        rows = [*range(len(each)), *range(len(together), len(together) + len(shared))]
        index = np.array([*each, *shared], np.intp)
        acting.append(index)
        own_slopes = changes[rows, c] / steps[index, None]
        place = {int(k): row for row, k in enumerate(index)}
        for k, row in place.items():
            for other, share in problem.parameters[k].along:
                own_slopes[row] -= share * own_slopes[place[other]]
        slopes.append(own_slopes)
    return Linearised(theta, residual, tuple(acting), tuple(slopes))
