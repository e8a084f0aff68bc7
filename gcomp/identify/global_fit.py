"""Global identification: sensors, mass moments and load point from all data at once (docs/theory.md, section 7)."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.identify.identifiability import Information, analyse, describe_null_space
from gcomp.identify.least_squares import LeastSquaresProblem, Outcome, solve
from gcomp.identify.linear_start import linear_start
from gcomp.identify.parameters import Parameters, Prior, family_slices, natural_units, parameter_names, prior_vectors
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import expected_readings, predict

MAX_STD = {"gain": 0.2, "offset": 0.5, "position_gain": 0.1, "position_offset": 0.35, "beta": 0.5, "rho": 0.2}
"""Standard deviation beyond which a value is of no use, per family: as a share of the gain, of the readings' RMS for
offsets, of that over g for mass moments; rad; m (docs/theory.md, section 7.3)."""
DOUBT = 2.0
"""Weighted squares per degree of freedom above which another start is tried (docs/theory.md, section 7.2)."""


@dataclass(frozen=True, eq=False)
class Precision:
    """Which parameters the readings determine, and how exactly."""

    std: Parameters
    """Standard deviations; inf if not identifiable, 0 if known."""
    names: tuple[str, ...]
    """Names of the p estimated parameters."""
    covariance: Array
    """Their covariance (p, p); NaN rows and columns for those that are not identifiable."""
    identifiable: Mask
    """Those that the readings and priors determine (p,)."""
    null_space: tuple[str, ...]
    """Parameters that the readings cannot separate, one sentence per null direction."""


@dataclass(frozen=True, eq=False)
class GlobalFit(Precision):
    """Result of the global identification. Known families keep their given values, with std 0."""

    values: Parameters
    """Estimates; NaN if not identifiable."""
    complete: Parameters
    """Estimates, all finite: parameters that are not identifiable have the values of the start."""
    hopeless: tuple[str, ...]
    """Parameters that are determined, but with a standard deviation beyond MAX_STD."""
    residual: Array
    """Reading minus model (K, n) [N·m]; NaN for readings that do not count."""
    chi2: float
    """Sum of squared residuals over their variance."""
    dof: int
    """Counted readings minus the rank."""
    converged: bool

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Names of the parameters that the readings do not determine."""
        return tuple(name for name, found in zip(self.names, self.identifiable, strict=True) if not found)

    def covariance_of(self, *names: str) -> Array:
        """Covariance of these parameters, in this order; raises KeyError if one was not estimated."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise KeyError(f"{missing[0]} was not estimated; expected one of {', '.join(self.names)}")
        at = [self.names.index(name) for name in names]
        return self.covariance[np.ix_(at, at)]

    @property
    def beta_covariance(self) -> Array:
        """Covariance of all mass moments (2n, 2n); zero if β was known, NaN for moments that are not identifiable."""
        moments = [name for name in self.names if name.startswith("mass_moment")]
        size = len(self.values.beta)
        return self.covariance_of(*moments) if moments else np.zeros((size, size))


def identify_global(
    arm: Arm,
    readings: StaticReadings,
    *,
    unknown: Collection[str],
    start: Parameters | None = None,
    priors: Mapping[str, Prior] | None = None,
    position_sigma: ArrayLike = 0.0,
) -> GlobalFit:
    """Estimate the families `unknown` by weighted least squares on the readings that count.

    The scale comes from readings with a reference mass or from a prior on the gains. `start` holds the values of known
    families and the first guess of the others (default Parameters.nominal). `position_sigma` () or (n,) [rad] is the
    noise of position readings, which adds to each reading's variance. Parameters that the readings do not determine
    keep the values of the start; all others come out as if those were known. Raises BadArray on wrong shapes and on
    unknown families.
    """
    readings.require_arm(arm)
    begin = start or _start_of(arm.n, priors or {})
    problem = LeastSquaresProblem.of(
        arm, readings, unknown, priors or {}, position_sigma, natural_units(arm, readings, begin)
    )
    starts = _starts(problem, begin)
    outcome = solve(problem, next(starts))
    for first in starts:
        if outcome.converged and outcome.cost < DOUBT * max(1, outcome.dof):
            break
        other = solve(problem, first)
        outcome = other if other.cost < outcome.cost else outcome
    return _report(problem, outcome)


def _starts(problem: LeastSquaresProblem, begin: Parameters) -> Iterator[Parameters]:
    """Starts in the order in which they are tried (docs/theory.md, section 7.2).

    Position errors bias the linear solution. Hence first everything but the scale from the readings without a reference
    mass and the scale from all readings; then the linear solution of all readings; then the values given.
    """
    n, places, loaded = problem.arm.n, family_slices(problem.arm.n), problem.readings.load != 0
    positions = slice(places["position_gain"].start, places["position_offset"].stop)
    if problem.free[positions].any() and problem.free[places["beta"]].any() and loaded.any() and not loaded.all():
        bare = problem.readings.rows(~loaded)
        if bare.counted.any():
            plain = linear_start(problem.arm, bare, begin, problem.free)
            found = Parameters.from_vector(solve(replace(problem, readings=bare).near(begin), plain).vector, n)
            yield linear_start(problem.arm, problem.readings, found, problem.free, keep_ratios=True)
    yield linear_start(problem.arm, problem.readings, begin, problem.free)
    yield begin


def predict_covariance(
    arm: Arm,
    design: StaticReadings,
    guess: Parameters,
    *,
    unknown: Collection[str],
    priors: Mapping[str, Prior] | None = None,
    position_sigma: ArrayLike = 0.0,
) -> Precision:
    """Precision that identify_global would report for readings at the design's positions and loads.

    NaN in the design's torques marks readings that would not count; other torques are not used. `guess` is the
    parameters expected.
    """
    design.require_arm(arm)
    expected = expected_readings(arm, guess, design)
    problem = LeastSquaresProblem.of(
        arm, expected, unknown, priors or {}, position_sigma, natural_units(arm, expected, guess)
    )
    weight = problem.weights(guess.vector)
    return _precision(problem, analyse(problem.factor(guess.vector, weight)[0], problem.unit[problem.free]))


def _start_of(n: int, priors: Mapping[str, Prior]) -> Parameters:
    """Nominal values, or the mean of the prior for parameters that have one."""
    mean, std = prior_vectors(n, priors)
    return Parameters.from_vector(np.where(np.isfinite(std), mean, Parameters.nominal(n).vector), n)


def _precision(problem: LeastSquaresProblem, information: Information) -> Precision:
    names = tuple(name for name, free in zip(parameter_names(problem.arm), problem.free, strict=True) if free)
    std = np.zeros(len(problem.free))
    spread = np.sqrt(np.diag(information.covariance))
    std[problem.free] = np.where(information.determined, spread, np.inf)
    null_space = describe_null_space(information.null_basis, names)
    known = Parameters.from_vector(std, problem.arm.n)
    return Precision(known, names, information.covariance, information.determined, null_space)


def _report(problem: LeastSquaresProblem, outcome: Outcome) -> GlobalFit:
    n, found = problem.arm.n, _precision(problem, outcome.information)
    std = found.std.vector
    values = np.where(np.isinf(std), np.nan, outcome.vector)
    limit = np.concatenate([np.full(place.stop - place.start, MAX_STD[f]) for f, place in family_slices(n).items()])
    beyond = (std > limit * problem.unit)[problem.free] & found.identifiable
    complete = Parameters.from_vector(outcome.vector, n)
    return GlobalFit(
        **vars(found),
        values=Parameters.from_vector(values, n),
        complete=complete,
        hopeless=tuple(name for name, is_beyond in zip(found.names, beyond, strict=True) if is_beyond),
        residual=problem.readings.torque - predict(problem.arm, complete, problem.readings),
        chi2=outcome.chi2,
        dof=outcome.dof,
        converged=outcome.converged,
    )
