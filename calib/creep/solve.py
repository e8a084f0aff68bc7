"""Damped Gauss-Newton solution of the creep fit, with a Gaussian prior on every unknown."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.creep.model import CreepModel
from calib.creep.scatter import Scatter
from gcomp.arrays import Array

MOST_STEPS = 60
"""Gauss-Newton steps after which the search ends."""
LEAST_IMPROVEMENT = 1e-9
"""A step that improves the cost by a smaller share of it ends the search."""


@dataclass(frozen=True, eq=False)
class CreepSolution:
    """Maximum of the posterior."""

    x: Array
    residual: Array
    """Reading less prediction (R,) [N·m]."""
    information: Array
    """Inverse covariance of x (P, P), by the standard deviations given."""

    @property
    def covariance(self) -> Array:
        """(P, P)."""
        return invert(self.information)


def solve(model: CreepModel, scatter: Scatter, mean: Array, std: Array, start: Array) -> CreepSolution:
    """The parameters for rows that scatter so, with the prior's mean and std (P,), from `start`."""
    x, damping = start.copy(), 1e-6
    reading = model.rows.reading

    def cost(at: Array) -> float:
        return float((scatter.whitened(reading - model.predict(at)) ** 2).sum() + (((at - mean) / std) ** 2).sum())

    now = cost(x)
    for _ in range(MOST_STEPS):
        predicted, jacobian = model.linearised(x)
        weighted = scatter.whitened(jacobian)
        information = weighted.T @ weighted + np.diag(1 / std**2)
        downhill = weighted.T @ scatter.whitened(reading - predicted) - (x - mean) / std**2
        before = now
        for _ in range(12):
            damped = information + damping * np.diag(np.diag(information))
            tried = x + _scaled_solve(damped, downhill)
            value = cost(tried)
            if value <= now:
                x, now, damping = tried, value, max(damping / 5, 1e-9)
                break
            damping *= 8
        if before - now <= LEAST_IMPROVEMENT * now:
            break
    predicted, jacobian = model.linearised(x)
    weighted = scatter.whitened(jacobian)
    return CreepSolution(x, reading - predicted, weighted.T @ weighted + np.diag(1 / std**2))


def invert(information: Array) -> Array:
    """Inverse of a positive definite matrix, in units in which its diagonal is 1."""
    scale = 1 / np.sqrt(np.diag(information))
    unit = information * np.outer(scale, scale)
    inverse: Array = cho_solve(cho_factor(unit), np.eye(len(unit)))
    return inverse * np.outer(scale, scale)


def _scaled_solve(matrix: Array, right: Array) -> Array:
    scale = 1 / np.sqrt(np.diag(matrix))
    found: Array = cho_solve(cho_factor(matrix * np.outer(scale, scale)), scale * right)
    return scale * found
