"""Belief about drives whose torque is a motor current, from rows of motion: friction, gravity, doubts.

The unknowns are those of `gcomp.identify.motor_model`, against readings that are corrected by the record in force:
gains are 1 and offsets 0 while nothing has changed. Records say how sure each value is, though not how gains and
mass moments go together, nor how friction changes over position: that is learned from work in which nothing changed.
"""

from copy import copy
from dataclasses import replace
from typing import Any, Self

import numpy as np

from calib.fit.calibration import NOISE_ROUNDS, USUAL_ROWS
from calib.fit.sweep_readings import FEWEST
from calib.motion.static_reading import StaticReading, batch, stack
from calib.observer.config import INITIAL_GAIN_STD, INITIAL_OFFSET_STD, PLACE_SIZE
from calib.observer.evidence import INEXACT, ChangeHypothesis, Residuals
from calib.observer.saved_values import read_rows, save_rows
from calib.records.records import CalibrationRecord, GravityRecord, MotorTorque, Parameter
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.motor_model import LAST_ZERO, MotorDoubt, MotorModel, family_slices
from gcomp.identify.readings import StaticReadings

REFERENCE = 360
"""Rows without a change that the belief is learned from: four minutes of creeping."""
ZERO_STD = 2e-3
"""Least standard deviation of a position zero [rad]: links give way."""
SIGMA_SHARE = 2e-3
"""Standard deviation of a row about the model where the record has none, as a share of rated torque."""
ALIKE = 2.0
"""The variance of rows is multiplied by this to begin with: what the model lacks is alike in neighbouring rows. Then it
is measured."""
FITTED = 5
"""Rows of a joint that its own parameters take up."""
UNKNOWN_WARMTH_STD = 0.01
"""Doubt of a gain where no temperature is known: a drive that warms by 10 K loses a hundredth."""
KNOWN_WARMTH_STD = 5e-4
"""Doubt of a gain where it is: drives tell whole kelvins."""


class MotorBelief:
    """Parameters and covariance of an arm's drives, and the standard deviation of a row."""

    of_sensors = False
    misfit_limit = 8.0
    """120 rows then scatter by 1.4 times what was learned. Friction of a joint is never quite what it was; a contact is
    far beyond."""
    change_std = 10 * np.array([INITIAL_GAIN_STD, INITIAL_OFFSET_STD])
    """A choice."""
    mass = 0.0
    payload_rank = 1
    is_known = True

    def __init__(self, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated: Array) -> None:
        """Of records of creep sweeps; rated torques (n,) [N·m]."""
        self.arm, n = arm, arm.n
        doubt = MotorDoubt()  # of what the records do not hold
        none = (0.0, 0.0)
        uncrept = MotorTorque(coulomb=none, load=none, viscous=none, asymmetry=none)  # its friction may be any
        motors = [joint.motor or uncrept for joint in calibration.joints]
        self._at = family_slices(n)
        self.mean = np.zeros(self._at["rho"].stop)
        std = np.zeros_like(self.mean)
        self.mean[self._at["gain"]] = 1.0
        size = np.abs(calibration.values("gain", 1.0))
        std[self._at["gain"]] = _known_std(calibration, "gain", doubt.gain) / size
        std[self._at["offset"]] = _known_std(calibration, "offset", doubt.offset_share * rated) / size
        zero = _known_std(calibration, "position_offset", 0.0)
        for family in ("coulomb", "load", "viscous", "asymmetry"):
            self.mean[self._at[family]], std[self._at[family]] = np.array([getattr(each, family) for each in motors]).T
        warming = np.array([each.gain_per_kelvin or (0.0, 0.0) for each in motors])
        self.mean[self._at["warming"]], std[self._at["warming"]] = warming.T
        self.reference_temperature = np.array(
            [np.nan if each.temperature is None else each.temperature for each in motors]
        )
        std[self._at["zero"]] = np.append(np.hypot(zero[:-1], ZERO_STD), LAST_ZERO)
        coulomb = np.maximum(self.mean[self._at["coulomb"]], 1e-3 * rated)
        std[self._at["uneven"]] = np.repeat(doubt.uneven * coulomb, (len(std[self._at["uneven"]])) // n)
        self.mean[self._at["beta"]] = gravity.beta
        self.covariance = np.diag(std**2)
        self.covariance[self._at["beta"], self._at["beta"]] = np.array(gravity.covariance)
        fitted = np.array([joint.residual_std or np.nan for joint in calibration.joints])
        self.sigma = np.sqrt(ALIKE) * np.where(np.isfinite(fitted), fitted, SIGMA_SHARE * rated)
        """Standard deviation of a row, and of what it has in common with its neighbours (n,) [N·m]."""
        self._reference: list[StaticReading] = []
        """Rows that the belief rests on, beside the records."""
        self._first = (self.mean, self.covariance, self.sigma)

    @property
    def learnt(self) -> int:
        return len(self._reference)

    @property
    def is_first(self) -> bool:
        return self.learnt < REFERENCE

    def residuals(self, window: StaticReadings, temperature: Array | None = None) -> Residuals:
        model = self._model(window, temperature)
        predicted, jacobian = model.linearised(self.mean)
        covariance = jacobian @ self.covariance @ jacobian.T
        covariance[np.diag_indices(len(jacobian))] += self.sigma[model.joint] ** 2
        untold = np.full(len(jacobian), True) if temperature is None else np.isnan(temperature[window.counted])
        untold |= np.isnan(self.reference_temperature[model.joint])
        by_gain = jacobian[:, self._at["gain"]] * np.where(untold, UNKNOWN_WARMTH_STD, KNOWN_WARMTH_STD)[:, None]
        nothing = np.zeros(self.arm.n)
        return Residuals(
            model.reading - predicted,
            covariance + by_gain @ by_gain.T,
            self._changes(model, jacobian),
            doubt=len(jacobian) / (self.learnt + USUAL_ROWS),
            of_model=nothing,
            level=nothing,
            relative_level=np.full(self.arm.n, INEXACT),
        )

    def _model(self, window: StaticReadings, temperature: Array | None) -> MotorModel:
        warm = np.full(window.position.shape, np.nan) if temperature is None else temperature
        warmth = np.where(window.counted, np.nan_to_num(warm - self.reference_temperature), 0.0)
        return MotorModel(self.arm, replace(window, warmth=warmth))

    def _changes(self, model: MotorModel, jacobian: Array) -> list[ChangeHypothesis]:
        at, found = self._at, list[ChangeHypothesis]()
        coulomb, load = self.mean[at["coulomb"]], self.mean[at["load"]]
        uneven = np.arange(at["uneven"].start, at["uneven"].stop).reshape(self.arm.n, -1)
        for j in np.flatnonzero(np.bincount(model.joint, minlength=self.arm.n) >= FEWEST).tolist():
            column = {name: jacobian[:, at[name].start + j] for name in ("gain", "offset", "coulomb", "load")}
            friction = coulomb[j] * column["coulomb"] + load[j] * column["load"]
            friction = friction + jacobian[:, uneven[j]] @ self.mean[uneven[j]]
            for cause, each in (("gain", column["gain"]), ("offset", column["offset"]), ("friction", friction)):
                if np.abs(each).max() > 1e-9:
                    found.append(ChangeHypothesis(cause, j, each[:, None]))
        per_unit = np.column_stack(payload_columns(self.arm))

        def about(values: Array) -> tuple[Array, Array]:
            """A payload's: friction goes with torque, whose sign a load may turn."""
            mean = self.mean.copy()
            mean[at["beta"]] += per_unit @ values
            predicted, turned = model.linearised(mean)
            return model.reading - predicted, turned[:, at["beta"]] @ per_unit

        payload = jacobian[:, at["beta"]] @ per_unit
        if np.abs(payload).max() > 1e-9:
            found.append(ChangeHypothesis("payload", None, payload, about=about))
        return found

    def anywhere(self, count: int) -> None:
        return None

    def before(self, position: Array) -> Self:
        same = [k for k, row in enumerate(self._reference) if np.array_equal(row.position, position)]
        if not same:
            return self
        earlier = copy(self)
        earlier._rest_on(self._reference[: same[0]])
        return earlier

    def learn(self, rows: list[StaticReading]) -> None:
        if rows and self.is_first:
            self._rest_on([*self._reference, *rows])

    def adapt(self, rows: list[StaticReading]) -> None:
        """While it is learned what the arm's own is; later rows that nothing explains are no scatter."""
        if self.is_first:
            model = self._model(batch(rows, self.sigma), stack(rows, "temperature"))
            self.sigma = np.maximum(self.sigma, self._scatter(model, model.reading - model.predict(self.mean)))

    def close(self) -> None: ...

    def _rest_on(self, rows: list[StaticReading]) -> None:
        self._reference = rows
        first_mean, first_covariance, self.sigma = self._first
        self.mean, self.covariance = first_mean, first_covariance
        if not rows:
            return
        model = self._model(batch(rows, self.sigma), stack(rows, "temperature"))
        for _ in range(NOISE_ROUNDS):
            predicted, jacobian = model.linearised(self.mean)
            noise = self.sigma[model.joint] ** 2
            target = model.reading - predicted + jacobian @ (self.mean - first_mean)
            of_mean = first_covariance @ jacobian.T
            gain = np.linalg.solve(jacobian @ of_mean + np.diag(noise), of_mean.T).T
            self.mean = first_mean + gain @ target
            self.covariance = first_covariance - gain @ of_mean.T
            self.sigma = self._scatter(model, model.reading - model.predict(self.mean))

    def _scatter(self, model: MotorModel, residual: Array) -> Array:
        """Standard deviation of a row (n,) [N·m]: as measured, drawn towards what was assumed.

        Neighbouring rows whose residuals are alike count for less than one each, as in `calib.fit.creep_residuals`.
        """
        usual, found = self._first[2], np.empty(self.arm.n)
        for j in range(self.arm.n):
            own = np.flatnonzero(model.joint == j)
            square = residual[own] ** 2
            variance = (square.sum() + USUAL_ROWS * usual[j] ** 2) / (max(len(own) - FITTED, 0) + USUAL_ROWS)
            near = np.abs(np.diff(model.readings.position[own, j])) < PLACE_SIZE
            common = float((residual[own][1:] * residual[own][:-1])[near].sum() / max(square[1:][near].sum(), 1e-12))
            found[j] = np.sqrt(variance * (1 + 2 * min(max(common, 0.0), 1.0)))
        return found

    def torque(self, q: Array) -> Array:
        return gravity_regressor(self.arm, q) @ self.mean[self._at["beta"]]

    def save(self) -> dict[str, Any]:
        """The rows that it rests on, as JSON values."""
        return {"learnt": save_rows(self._reference)}

    def restore(self, values: dict[str, Any]) -> None:
        self._rest_on(read_rows(values["learnt"], self.arm.n))


def _known_std(calibration: CalibrationRecord, parameter: Parameter, before: Array | float) -> Array:
    """Standard deviations (n,) of the record; where it has none, what is assumed before any sweep."""
    std = calibration.std(parameter)
    return np.where(np.isnan(std), before, std)
