"""Most probable parameters of readings with normal errors and a normal prior, and their covariance."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from gcomp.arrays import Array
from gcomp.estimate.problem import Index

TRUST = {"initial_trust_radius": 100.0, "max_trust_radius": 1e4}
"""Length of a step [standard deviations of the prior]: most problems are nearly linear within all that is plausible."""
MOST_STEPS = 200
"""Steps, of which some ten are taken; where friction changes its sign the search may go to and fro about the end."""


class ReadingModel(Protocol):
    """Readings (R,) as a function of P parameters."""

    @property
    def reading(self) -> Array:
        """As measured (R,)."""

    def predict(self, x: Array) -> Array:
        """As expected (R,)."""

    def linearised(self, x: Array) -> tuple[Array, Array]:
        """(Expected (R,), derivatives (R, P))."""


@dataclass(frozen=True, eq=False)
class PartialModel:
    """A reading model of which some parameters (F,) are free; the others are known."""

    whole: ReadingModel
    known: Array
    """All parameters (P,)."""
    free: Index

    @property
    def reading(self) -> Array:
        return self.whole.reading

    def complete(self, x: Array) -> Array:
        """All parameters (P,) for free ones (F,)."""
        found = self.known.copy()
        found[self.free] = x
        return found

    def predict(self, x: Array) -> Array:
        return self.whole.predict(self.complete(x))

    def linearised(self, x: Array) -> tuple[Array, Array]:
        expected, jacobian = self.whole.linearised(self.complete(x))
        return expected, jacobian[:, self.free]


@dataclass(frozen=True, eq=False)
class PosteriorFit:
    """Maximum of the posterior."""

    x: Array
    residual: Array
    """Reading less prediction (R,), in the readings' unit."""
    information: Array
    """Inverse covariance of x (P, P)."""
    chi2: float
    """Weighted squares of the residuals and of the distance from the prior."""

    @cached_property
    def covariance(self) -> Array:
        """(P, P)."""
        return invert(self.information)


def most_probable(
    model: ReadingModel,
    whiten: Callable[[Array], Array],
    mean: Array,
    std: Array,
    start: Array,
    gradient: float = 1e-4,
) -> PosteriorFit:
    """Parameters with a prior of this mean and std (P,), by Gauss-Newton steps in a trust region.

    `whiten` makes columns (R, …) such that the readings' errors have unit variance and nothing in common. The end is at
    most `gradient` posterior standard deviations from the maximum.
    """
    reading = model.reading

    def cost(z: Array) -> float:
        return 0.5 * float(np.sum(whiten(reading - model.predict(mean + std * z)) ** 2) + z @ z)

    def slopes(x: Array) -> tuple[Array, Array, Array]:
        """(Residual, gradient of the cost and its derivatives, in standard deviations of the prior)."""
        expected, jacobian = model.linearised(x)
        white, residual = whiten(jacobian) * std, reading - expected
        return residual, (x - mean) / std - white.T @ whiten(residual), white.T @ white + np.eye(len(x))

    last = start, slopes(start)

    def slopes_at(z: Array) -> tuple[Array, Array, Array]:
        nonlocal last
        x = mean + std * z
        if not np.array_equal(x, last[0]):
            last = x, slopes(x)
        return last[1]

    first = (start - mean) / std
    end = minimize(
        cost,
        first,
        jac=lambda z: slopes_at(z)[1],
        hess=lambda z: slopes_at(z)[2],
        method="trust-exact",
        options={**TRUST, "gtol": gradient, "maxiter": MOST_STEPS},
    )
    x = mean + std * end.x
    residual, _, information = slopes(x)
    return PosteriorFit(x, residual, information / np.outer(std, std), 2 * float(end.fun))


def invert(information: Array) -> Array:
    """Inverse of a positive definite matrix, in units in which its diagonal is 1."""
    scale = 1 / np.sqrt(np.diag(information))
    inverse: Array = cho_solve(cho_factor(information * np.outer(scale, scale)), np.eye(len(information)))
    return inverse * np.outer(scale, scale)


def linear_posterior(columns: Array, target: Array, mean: Array, std: Array) -> PosteriorFit:
    """The same where readings (R,) are columns (R, P) times parameters, both in standard deviations of the readings."""
    white, left = columns * std, target - columns @ mean
    information = white.T @ white + np.eye(len(std))
    z = cho_solve(cho_factor(information), white.T @ left)
    residual = left - white @ z
    return PosteriorFit(mean + std * z, residual, information / np.outer(std, std), float(residual @ residual + z @ z))
