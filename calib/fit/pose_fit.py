"""Gravity, friction and torque gains from poses at rest or in slow motion, recorded with whatever moves the arm.

The readings of all joints in every pose make one problem: the motor model of creep sweeps (docs/theory.md, section 11),
position zeros taken as read. Its priors are those of a sound arm; the scatter is what the readings show.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calib.fit.calibration import NOISE_ROUNDS, rms
from calib.fit.creep_fit import LEAST_COULOMB, SEEN
from calib.fit.creep_residuals import LEAST_STD_SHARE, inflation
from calib.fit.field_fit import BLOCK
from calib.fit.gravity_fit import GravityFit
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import VERTICAL
from gcomp.arrays import Array, Mask
from gcomp.design.selection import select
from gcomp.estimate.posterior import PartialModel, PosteriorFit, invert, most_probable
from gcomp.estimate.problem import FREEDOM, EstimationProblem
from gcomp.estimate.solve import robust_weight, scale_of
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.identifiability import analyse, describe_null_space
from gcomp.identify.motor_model import MotorDoubt, MotorModel, family_slices
from gcomp.identify.parameters import Parameters, natural_units, parameter_names
from gcomp.identify.parameters import family_slices as sensor_slices
from gcomp.identify.readings import StaticReadings

SENSOR_GAIN_STD = 0.03
"""Standard deviation of the gain of a torque sensor on the link (docs/theory.md, section 7)."""
ACCURACY = 0.01
"""Distance from the most probable values at which the search ends, in standard deviations of the posterior."""
CANDIDATES = 300
"""Poses, drawn within the limits, of which the further ones are chosen."""
DRAWS = 1000
"""Of the posterior, for the bound on the RMS of gravity: its 95 % quantile is then known to 3 %."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Mass moments, with gains, offsets and friction beside them."""

    arm: Arm
    readings: StaticReadings
    nominal: Array
    """Mass moments of the model (2n,) [kg·m], which stay where the poses tell nothing."""
    model: PartialModel
    solution: PosteriorFit
    prior_mean: Array
    """Of all parameters."""
    prior_std: Array
    white: Array
    """Root weight of each reading (R,) [1/(N·m)]."""
    scale: str
    """The joint whose gain counts as 1, since no reference mass tells the scale of all torques; empty if one does."""
    sources: dict[str, str]

    @cached_property
    def x(self) -> Array:
        """All parameters, with the known ones."""
        return self.model.complete(self.solution.x)

    @cached_property
    def covariance(self) -> Array:
        """Of all parameters; 0 for known ones."""
        whole = np.zeros((len(self.x), len(self.x)))
        whole[np.ix_(self.model.free, self.model.free)] = self.solution.covariance
        return whole

    def estimate(self, family: str) -> tuple[Array, Array]:
        """Values of a family of the motor model, and their standard deviations."""
        place = family_slices(self.arm.n)[family]
        return self.x[place], np.sqrt(np.maximum(np.diag(self.covariance)[place], 0.0))

    def found(self, family: str) -> Mask:
        """Values that the poses themselves tell."""
        std, before = self.estimate(family)[1], self.prior_std[family_slices(self.arm.n)[family]]
        return np.asarray((std > 0) & (std < SEEN * before))

    @property
    def mass(self) -> float:
        """Largest reference mass [kg]; 0 where none was hung."""
        return float(self.readings.load.max())

    @cached_property
    def gravity(self) -> GravityFit:
        """Mass moments without the reference mass; those that the poses do not determine stay near the model's."""
        place = family_slices(self.arm.n)["beta"]
        return GravityFit(
            names=self.arm.names,
            beta=self.x[place],
            covariance=self.covariance[place, place],
            identifiable=self._identifiability[0],
            recursive=None,
            residual_rms=rms(self.readings.table(self.solution.residual)),
            sources=self.sources,
        )

    @property
    def not_determined(self) -> tuple[str, ...]:
        """A sentence for each direction of gains and mass moments that the poses leave open."""
        of_scale = (
            f"a factor common to all torques and masses; it is set so that the gain of {self.scale} is 1. Poses with a "
            "known mass determine this factor (--reference-mass FILE=KG)"
        )
        return (*[of_scale] * bool(self.scale), *self._identifiability[1])

    @cached_property
    def _identifiability(self) -> tuple[Mask, tuple[str, ...]]:
        n, own, sensor = self.arm.n, family_slices(self.arm.n), sensor_slices(self.arm.n)
        both = np.stack([np.r_[slices["gain"], slices["beta"]] for slices in (own, sensor)])
        free, places = both[:, np.diag(self.covariance)[both[0]] > 0]
        names = np.array(parameter_names(self.arm))
        unit = natural_units(self.arm, self.readings, Parameters.nominal(n))[places]
        triangle = np.asarray(np.linalg.cholesky(invert(self.covariance[np.ix_(free, free)])).T, float)
        information = analyse(triangle, unit)
        determined = np.zeros(2 * n, dtype=bool)
        moments = free >= own["beta"].start
        determined[free[moments] - own["beta"].start] = information.determined[moments]
        return determined, describe_null_space(information.null_basis, tuple(names[places].tolist()))

    def bound(self, q: Array) -> Array:
        """95 % bound of each joint's RMS error of gravity torque over the poses q (K, n) [rad], (n,) [N·m]."""
        place = family_slices(self.arm.n)["beta"]
        values, vectors = np.linalg.eigh(self.covariance[place, place])
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        draws = root @ np.random.default_rng(0).standard_normal((len(root), DRAWS))
        mean = np.einsum("kic,kid->icd", *[gravity_regressor(self.arm, q)] * 2, optimize=True) / len(q)
        squares = np.einsum("cs,icd,ds->is", draws, mean, draws, optimize=True)
        return np.asarray(np.sqrt(np.quantile(squares, 0.95, axis=1)))

    def held_out(self) -> Array:
        """RMS of each joint's readings, in blocks of neighbours, as the fit of all others predicts them (n,) [N·m]."""
        _, jacobian = self.model.linearised(self.solution.x)
        columns = jacobian * self.white[:, None]
        left, rows = self.white * self.solution.residual, np.nonzero(self.readings.counted)[0]
        error = np.empty_like(left)
        series = [np.flatnonzero(self.readings.series == each) for each in np.unique(self.readings.series)]
        for part in (each[k : k + BLOCK] for each in series for k in range(0, len(each), BLOCK)):
            block = np.isin(rows, part)
            hat = columns[block] @ self.solution.covariance @ columns[block].T
            error[block] = np.linalg.solve(np.eye(len(hat)) - hat, left[block])
        return rms(self.readings.table(error / self.white))

    def errors(self, readings: StaticReadings) -> Array:
        """Readings less their prediction (K, n) [N·m]; NaN for those that do not count."""
        model = MotorModel(self.arm, readings)
        return readings.table(model.reading - model.predict(self.x))

    def with_nominal_moments(self) -> "PoseFit":
        """The fit with the mass moments of the model, all else as free as here."""
        own = family_slices(self.arm.n)["beta"]
        free = self.model.free[(self.model.free < own.start) | (self.model.free >= own.stop)]
        known = self.model.known.copy()
        known[own] = self.nominal
        model, std = PartialModel(self.model.whole, known, free), self.prior_std[free]
        whiten = partial(_whitened, self.white)
        solution = most_probable(model, whiten, self.prior_mean[free], std, self.x[free], ACCURACY)
        return replace(self, model=model, solution=solution)

    def best_poses(self, count: int) -> tuple[Array, Array]:
        """Further poses (C, n) [rad] within the limits that together tell most (D-optimal), and the bound (n,) [N·m]
        of gravity's RMS error over the recorded poses after them; each is read from both sides, without a mass."""
        arm, n = self.arm, self.arm.n
        lower, upper = np.clip(arm.lower, -np.pi, None), np.clip(arm.upper, None, np.pi)
        poses = np.random.default_rng(0).uniform(lower, upper, (CANDIDATES, n))
        sides = np.tile([[1.0], [-1.0]], (CANDIDATES, n)) * self.readings.direction.any()
        q = np.repeat(poses, 2, axis=0)
        readings = StaticReadings(q, np.zeros_like(q), np.ones(n), direction=sides)
        weight = _mean(self.white**2, self.readings.counted)
        noise = 1 / np.sqrt(np.where(weight > 0, weight, weight.max()))
        _, columns = PartialModel(MotorModel(arm, readings), self.x, self.model.free).linearised(self.solution.x)
        columns = (columns.T / np.tile(noise, len(q))).T.reshape(CANDIDATES, -1, len(self.solution.x))
        unit = np.sqrt(np.diag(self.solution.covariance))
        own = self.solution.information * np.outer(unit, unit)
        rows = columns * unit
        chosen = select([rows[None]], own[None], [count], exchanges=0)[0]
        best = rows[chosen].reshape(-1, len(unit))
        information = (own + best.T @ best) / np.outer(unit, unit)
        after = replace(self, solution=replace(self.solution, information=information))
        return poses[chosen], after.bound(self.readings.position)


def fit_poses(
    arm: Arm,
    readings: StaticReadings,
    rated: Array,
    nominal: Array,
    gain_std: float,
    sources: dict[str, str] | None = None,
) -> PoseFit:
    """The most probable arm; `readings.sigma` is what is doubted of a reading beside the scatter that will show.

    `rated` (n,) [N·m] scales the doubt beforehand; `nominal` (2n,) [kg·m] are mass moments from which those of the arm
    may be as far as any.
    """
    readings.require_arm(arm)
    slices, model = family_slices(arm.n), MotorModel(arm, readings)
    doubt = MotorDoubt(gain=max(gain_std, 1e-6))
    families = ["gain", "offset", "beta", *["rho"] * bool(readings.load.any())]
    families += ["coulomb", "load", "asymmetry", "uneven"] if readings.direction.any() else []
    families += ["viscous", "lag"] if readings.velocity.any() else []
    free = np.sort(np.r_[tuple(slices[name] for name in families)])
    mean, std = doubt.prior(arm, rated, True, 0.02 * rated)
    mean[slices["beta"]] = nominal
    known = np.where(np.isin(np.arange(len(mean)), free), mean, 0.0)
    known[slices["gain"]] = 1.0
    scale = ""
    if not readings.load.any():
        lever = np.linalg.norm(gravity_regressor(arm, readings.position), axis=-1).mean(axis=0)
        most = int(np.argmax(rms(readings.torque) * (lever > VERTICAL * np.linalg.norm(arm.gravity))))
        scale, free = arm.names[most] * (gain_std > 0), free[free != slices["gain"].start + most]
    own, x = PartialModel(model, known, free), mean[free]
    white = 1 / np.hypot(0.01 * rated[model.joint], readings.sigma[readings.counted])
    for last in range(NOISE_ROUNDS, 0, -1):
        solution = most_probable(own, partial(_whitened, white), mean[free], std[free], x, ACCURACY)
        x = solution.x
        coulomb = np.maximum(np.abs(own.complete(x)[slices["coulomb"]]), LEAST_COULOMB * rated)
        determined = float(np.sum(1 - np.diag(solution.covariance) / std[free] ** 2))
        if last > 1:
            std = doubt.prior(arm, rated, True, coulomb)[1]
            white = _root_weights(readings, solution.residual, white, determined, LEAST_STD_SHARE * rated)
    return PoseFit(arm, readings, nominal, own, solution, mean, std, white, scale, sources or {})


def _whitened(white: Array, columns: Array) -> Array:
    """Columns (R, …) times the root weights (R,)."""
    return np.asarray((columns.T * white).T)


def _root_weights(readings: StaticReadings, residual: Array, white: Array, determined: float, floor: Array) -> Array:
    """Root weight of each reading (R,) [1/(N·m)] by the scatter of its joint's residuals (R,).

    Student's t as the core has it; a joint's weights are such that they stand for as many normal readings as its
    residuals are worth (Huber's variance of an M-estimate), what neighbours have in common taken into account.
    """
    counted = readings.counted
    variance = _mean(white**-2.0, counted)
    spread = np.sqrt(1 + readings.sigma**2 / np.where(variance > 0, variance, 1.0))
    """Of a reading that is doubted beforehand, over that of the others of its joint."""
    left = (np.nan_to_num(readings.table(residual)) / spread).T
    problem = EstimationProblem((), lambda theta: theta, counted.T.astype(float), readings.series, floor)
    variance = scale_of(problem, left)
    weight = robust_weight(left, variance, FREEDOM)
    z2 = left**2 / variance[:, None]
    slope = (FREEDOM + 1) * (FREEDOM - z2) / (FREEDOM + z2) ** 2
    share = max(1 - determined / max(len(residual), 1), 0.2)
    out = np.zeros(counted.T.shape)
    for joint, rows in enumerate(counted.T):
        if not rows.any():
            continue
        w, flat = weight[joint, rows], max(float(slope[joint, rows].mean()), 1 / (FREEDOM + 1))
        worth = float(np.mean(w**2 * z2[joint, rows])) / flat**2 * variance[joint] / share
        parts = [left[joint, rows & (readings.series == each)] for each in np.unique(readings.series[rows])]
        worth = max(worth * inflation(parts), float(floor[joint]) ** 2)
        out[joint, rows] = np.sqrt(w / w.mean() / worth)
    return np.asarray((out.T / spread)[counted])


def _mean(values: Array, counted: Mask) -> Array:
    """Mean of each joint's values (R,), (n,)."""
    joint = np.nonzero(counted)[1]
    n = counted.shape[1]
    return np.asarray(np.bincount(joint, values, minlength=n) / np.maximum(np.bincount(joint, minlength=n), 1))
