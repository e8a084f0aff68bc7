"""Residuals of measurements as a function of parameters, and their derivatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array

Index = NDArray[np.intp]
FREEDOM = 4.0
"""Degrees of freedom of Student's t (Lange, Little and Taylor, JASA 84, 1989)."""
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

    def within(self, theta: Array) -> Array:
        return np.clip(theta, [p.low for p in self.parameters], [p.high for p in self.parameters])

    @property
    def nominal(self) -> Array:
        return np.array([p.nominal for p in self.parameters])


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
    points = [theta] if residual is None else []
    for some in (*together, *([k] for k in shared)):
        moved = theta.copy()
        moved[some] += steps[some]
        for k in some:
            for other, share in problem.parameters[k].along:
                moved[other] += share * steps[k]
        points.append(moved)
    answers = problem.predict(np.stack(points)) if points else np.empty((0, *problem.weight.shape))
    if residual is not None:
        answers = np.concatenate([residual[None], answers])
    acting, slopes = [], []
    for c, each in enumerate(own):
        rows = [*range(1, 1 + len(each)), *range(1 + len(together), 1 + len(together) + len(shared))]
        index = np.array([*each, *shared], np.intp)
        acting.append(index)
        own_slopes = (answers[rows, c] - answers[0, c]) / steps[index, None]
        place = {int(k): row for row, k in enumerate(index)}
        for k, row in place.items():
            for other, share in problem.parameters[k].along:
                own_slopes[row] -= share * own_slopes[place[other]]
        slopes.append(own_slopes)
    return Linearised(theta, answers[0], tuple(acting), tuple(slopes))
