"""Belief about the gravity model and what it lacks, adapted to the sensors as they were installed."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading, stack
from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD
from calib.observer.discrepancy import DiscrepancyLevel, Kernel, Posterior, Reference, Rows
from calib.observer.evidence import ChangeHypothesis, Residuals
from calib.observer.saved_values import restored
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, as_array
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

WANDER = 0.5
"""How far a zero may have moved with temperature since the reference, as a share of the discrepancy's level: a sensor
of class 0.05 moves by 0.1 % of rated torque in 20 K, and an arm of such sensors has a discrepancy of 0.2 to 0.4 %."""
THERMAL, TOLD = 1.0, 0.3
"""Where drives tell their temperature: how far a zero follows a rise of 20 K, as a share of the level, and the share of
WANDER that is left, since the sensor's own temperature is another."""
LEVEL_ARRAYS = ("smooth", "rough", "before", "spread")
LEVEL_ROWS = 10
"""Rows that what was expected of the discrepancy's level counts for beside those it was fitted to."""


def dictionary(arm: Arm, beta: Array, window: StaticReadings) -> Iterator[ChangeHypothesis]:
    """Every entry of the dictionary for the true angles of a window; beta (2n,) [kg·m] is the present gravity model."""
    q, n = window.position, arm.n
    regressor = gravity_regressor(arm, q)
    torque = regressor @ beta
    middle = np.where(np.isfinite(arm.lower + arm.upper), (arm.lower + arm.upper) / 2, 0.0)
    one = np.ones(len(q))

    def row_of(joint: int, *columns: Array) -> Array:
        full = np.zeros((len(q), n, len(columns)))
        full[:, joint] = np.stack(columns, axis=1)
        return full.reshape(len(q) * n, len(columns))

    for j in range(n):
        yield ChangeHypothesis("gain", j, row_of(j, torque[:, j]), family="drift")
        yield ChangeHypothesis("offset", j, row_of(j, one), family="drift")
        yield ChangeHypothesis("drift", j, row_of(j, torque[:, j], one))
        yield ChangeHypothesis("friction", j, row_of(j, window.direction[:, j]))
        yield ChangeHypothesis("spring", j, row_of(j, q[:, j] - middle[j], one))
    stiffness = gravity_stiffness(arm, beta, q)
    for j in range(n):
        yield ChangeHypothesis("slip", j, stiffness[:, :, j].reshape(-1, 1))
    yield ChangeHypothesis("payload", None, (regressor @ np.column_stack(payload_columns(arm))).reshape(-1, 4))
    across = np.linalg.svd(arm.gravity[None])[2][1:] * np.linalg.norm(arm.gravity)
    tilted = [gravity_regressor(replace(arm, gravity=direction), q) @ beta for direction in across]
    yield ChangeHypothesis("tilt", None, np.stack(tilted, axis=-1).reshape(-1, 2))
    # a payload explains nine tenths of a common scale and is far more frequent: at the same price it wins
    yield ChangeHypothesis("scale", None, torque.reshape(-1, 1), price=4)


@dataclass(frozen=True)
class Expected:
    """Residuals that the belief expects at K poses while no sensor has drifted."""

    torque: Array
    """Gravity torque of the model, against which residuals are (K, n) [N·m]."""
    mean: Array
    """(K, n) [N·m]."""
    blocks: Array
    """Covariance of each joint's discrepancy (n, K, K) [N²·m²]."""
    columns: Array
    """Columns (K·n, P) of the model's uncertainty, with unit prior, shared by the joints."""

    @cached_property
    def covariance(self) -> Array:
        """Of all residuals (K·n, K·n), row by row as `columns`."""
        n = len(self.blocks)
        covariance = self.columns @ self.columns.T
        for j in range(n):
            covariance[j::n, j::n] += self.blocks[j]
        return covariance

    def of_joint(self, j: int) -> Array:
        """Covariance (K, K) of one joint's residuals."""
        n = len(self.blocks)
        columns = self.columns[j::n]
        return np.asarray(self.blocks[j] + columns @ columns.T)

    @property
    def variance(self) -> Array:
        """(K, n) [N²·m²]."""
        n, count, _ = self.blocks.shape
        own = np.diagonal(self.blocks, axis1=1, axis2=2).T
        return np.asarray(own + (self.columns**2).sum(axis=1).reshape(count, n))


class GravityBelief:
    """β ~ N(β̂, F Fᵀ), the position sensors' zeros, and a discrepancy over poses, all narrowed by reference rows.

    Reference rows are known to be free of drift; from then on drift is measured against them. This also removes a scale
    error common to the calibration and the gravity model, which no later observation could show.
    """

    of_sensors = True
    misfit_limit = 4.0
    """docs/theory.md, section 6."""
    change_std = np.array([INITIAL_GAIN_STD, INITIAL_OFFSET_STD])

    def __init__(
        self,
        arm: Arm,
        beta: Array,
        covariance: Array,
        position_std: float = 0.0,
        level: DiscrepancyLevel | None = None,
        first_rows: int = 120,
        wander: Array | float = np.inf,
        sigma: Array | None = None,
    ) -> None:
        """beta (2n,) [kg·m], covariance (2n, 2n) [kg²·m²], with zero rows for what gravity does not determine.

        position_std [rad] is that of a position sensor's zero; without a level the model has no other errors. wander
        (n,) [N·m]: most that zeros move with temperature (standard deviation). first_rows: rows of the
        first epoch, and the most that the level is fitted to, evenly chosen: with 120 it is known to 7 %, in 50 ms.
        sigma (n,) [N·m]: of one row to begin with.
        """
        self.arm = arm
        self.beta: Array = np.array(beta, dtype=float)
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        kept = values > 1e-12 * max(values[-1], 1e-300)
        self._factor: Array = vectors[:, kept] * np.sqrt(values[kept])
        self._tool: Array = np.empty((self.beta.size, 0))
        self._position_std, self._wander, self._first_rows = position_std, wander, first_rows
        self.mass = 0.0
        """Mass of the loads that the model has taken over as tools [kg]."""
        self.level = DiscrepancyLevel.none(arm.n) if level is None else level
        self.sigma: Array = np.zeros(arm.n) if sigma is None else np.asarray(sigma, dtype=float)
        self._noise: Array = np.zeros(arm.n)
        """`sigma` when rows were learned last."""
        self._reference = Reference(arm.n, first_rows)
        self._posterior: Posterior | None = None
        self._kernel: Kernel | None = None

    @property
    def kernel(self) -> Kernel:
        """Unit covariance of the discrepancy."""
        if self._kernel is None:
            self._kernel = Kernel(self.arm, self.beta)
        return self._kernel

    @property
    def payload_rank(self) -> int:
        return self.kernel.payload_rank

    @property
    def is_known(self) -> bool:
        return self.level.is_known

    @property
    def learnt(self) -> int:
        return len(self._reference.rows)

    @property
    def is_first(self) -> bool:
        """Whether the reference's first epoch is still open."""
        return self._reference.is_first

    def torque(self, q: Array) -> Array:
        """Gravity torque (K, n) [N·m] at poses q (K, n)."""
        return gravity_regressor(self.arm, q) @ self.beta

    def expected(self, q: Array, side: Array, temperature: Array | None = None) -> Expected:
        """Residuals to expect at poses q [rad], sides of approach and temperatures [°C], (K, n) each."""
        if self._posterior is None:
            self._posterior = self._learn(self._reference.rows)
        warmer = np.full(q.shape, np.nan) if temperature is None else temperature - self._reference.temperature
        regressor = gravity_regressor(self.arm, q)
        torque: Array = regressor @ self.beta
        points = self.kernel.points(q, side, np.nan_to_num(warmer), torque)
        mean, blocks, columns = self._posterior.predict(points, self._columns(q, regressor))
        untold = np.where(np.isfinite(warmer).all(axis=0), TOLD, 1.0)
        blocks += (untold * np.minimum(WANDER * self.level.total, self._wander))[:, None, None] ** 2
        flat = columns.swapaxes(0, 1).reshape(q.size, -1)
        tool = (regressor @ self._tool).reshape(q.size, -1)
        return Expected(torque, mean, blocks, np.hstack([flat, tool]))

    def residuals(self, window: StaticReadings, temperature: Array | None = None) -> Residuals:
        expected = self.expected(window.position, window.direction, temperature)
        residual = window.torque - expected.torque - expected.mean
        covariance = expected.covariance.copy()
        covariance[np.diag_indices_from(covariance)] += window.sigma.ravel() ** 2
        noise, level = (window.sigma**2).mean(axis=0), self.level.total
        return Residuals(
            residual.ravel(),
            covariance,
            list(dictionary(self.arm, self.beta, window)),
            doubt=len(window.position) / (self.level.rows + LEVEL_ROWS) if level.any() else 0.0,
            of_model=1 - noise / (noise + expected.variance.mean(axis=0)),
            level=level,
            relative_level=level / self.kernel.typical,
        )

    def anywhere(self, count: int) -> StaticReadings:
        position = self.kernel.poses[:count]
        return StaticReadings.of(position, self.torque(position), self.sigma)

    def before(self, position: Array) -> "GravityBelief":
        """The belief from the reference rows before the one of this pose (n,): what a window is tested against."""
        rows = self._reference.before(position)
        if len(rows) == len(self._reference.rows):
            return self
        earlier = copy(self)
        earlier._posterior = self._learn(rows)
        return earlier

    def carry(self, values: Array, covariance: Array) -> None:
        """Add a tool: mass [kg] and first moment [kg·m] (4,), covariance (4, 4), as a payload verdict has them."""
        columns = np.column_stack(payload_columns(self.arm))
        self.beta = self.beta + columns @ values
        square, vectors = np.linalg.eigh(covariance)  # 0 for what no lever shows
        self._tool = columns @ (vectors * np.sqrt(np.maximum(square, 0.0)))
        self.mass += float(values[0])
        self._reference.close()
        self._kernel = self._posterior = None

    def learn(self, rows: list[StaticReading]) -> None:
        if not rows or not self._reference.add(*self._columns_of(rows)):
            return
        self._noise, self._posterior = self.sigma, None
        self._fit_level(self._reference.rows)

    def adapt(self, rows: list[StaticReading]) -> None:
        """Adapt the level alone, to rows that may have an offset, a gain or a payload that is not known."""
        self._noise, self._posterior = self.sigma, None
        position, residual, side, _ = self._columns_of(rows)
        self._fit_level(self._reference.rows.and_then(position, residual, side, np.full(side.shape, np.nan), epoch=-1))

    def _columns_of(self, rows: list[StaticReading]) -> tuple[Array, Array, Array, Array]:
        """Positions, residuals, sides of approach and temperatures (K, n) of rows."""
        q = stack(rows, "position")
        residual = stack(rows, "torque") - self.torque(q)
        return q, residual, stack(rows, "direction"), stack(rows, "temperature")

    def close(self) -> None:
        """A sensor was corrected: rows from now on tell nothing of gains and offsets."""
        self._reference.close()

    def _fit_level(self, rows: Rows) -> None:
        if not self.level.before.any():
            return
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(self._first_rows, len(rows))).astype(int))]
        points, n = self.kernel.points(rows.position, rows.side), self.arm.n
        regressor = gravity_regressor(self.arm, rows.position)
        payload = regressor @ np.column_stack(payload_columns(self.arm))
        free = [payload.swapaxes(0, 1)]
        for epoch in np.unique(rows.epoch):
            within = (rows.epoch == epoch).astype(float)
            free.append(np.broadcast_to(within[None, :, None], (n, len(rows), 1)))
            free.append((points.torque.T * within)[:, :, None])
        columns = np.concatenate(free, axis=2)
        if len(rows) < columns.shape[2] + 5:
            return
        known = self._columns(rows.position, regressor).swapaxes(0, 1)
        unit = self.kernel.between(points, points)
        self.level = self.level.fitted(unit, rows.residual.T, self._noise, known, columns)

    def _learn(self, rows: Rows) -> Posterior:
        warmer = np.nan_to_num(rows.temperature - self._reference.temperature)
        points = self.kernel.points(rows.position, rows.side, warmer)
        columns = self._columns(rows.position, gravity_regressor(self.arm, rows.position))
        free = 0.1 * self.kernel.typical + 20 * self._noise
        thermal = np.minimum(THERMAL * self.level.total, self._wander)
        return Posterior(self.kernel, self.level, self._noise, free, thermal, rows, points, columns)

    def _columns(self, q: Array, regressor: Array) -> Array:
        """Columns (K, n, P) of the model's stated uncertainty: of β and of the position sensors' zeros."""
        of_position = gravity_stiffness(self.arm, self.beta, q) * self._position_std
        return np.concatenate([regressor @ self._factor, of_position], axis=2)

    def save(self) -> dict[str, Any]:
        """Parameters, factor of their covariance, tool, level and reference rows, as JSON values."""
        level = {name: getattr(self.level, name).tolist() for name in LEVEL_ARRAYS}
        return {
            "beta": self.beta.tolist(),
            "factor": self._factor.tolist(),
            "tool": self._tool.tolist(),
            "mass": self.mass,
            "sigma": self.sigma.tolist(),
            "noise": self._noise.tolist(),
            "level": {**level, "rows": self.level.rows},
        } | self._reference.save()

    def restore(self, values: dict[str, Any]) -> None:
        """States of before the discrepancy have no level and no reference rows: those begin again."""
        size, n, saved = self.beta.size, self.arm.n, values.get("level")
        self.beta = as_array("beta", values["beta"], (size,))
        self.sigma = as_array("sigma", values["sigma"], (n,))
        self._factor = as_array("factor", values["factor"], (size, None))
        self._tool = as_array("tool", np.reshape(values.get("tool", []), (size, -1)), (size, None))
        self._noise, self.mass = as_array("noise", values.get("noise", np.zeros(n)), (n,)), float(values["mass"])
        if saved is not None:
            stds = {name: as_array(name, saved[name], np.shape(getattr(self.level, name))) for name in LEVEL_ARRAYS}
            self.level = DiscrepancyLevel(**stds, rows=int(saved["rows"]))
        self._reference = restored(self._reference, values)
        self._kernel = self._posterior = None
