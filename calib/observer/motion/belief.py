"""Belief about drives whose torque is a motor current: friction, gravity and their doubts.

The unknowns are those of `gcomp.identify.motor_model`, against readings that are corrected by the record in force:
gains are 1 and offsets 0 while nothing has changed. Records say how sure each value is, though not how gains and
mass moments go together, nor how friction changes over position: that is learned from work in which nothing changed.
"""

from collections.abc import Sequence
from copy import copy
from typing import Self

import numpy as np

from calib.observer.config import NOISE_ROWS
from calib.observer.motion.passages import Passage
from calib.records.records import CalibrationRecord, GravityRecord, MotorTorque
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.motor_model import LAST_ZERO, MotorDoubt, MotorModel, family_slices
from gcomp.identify.readings import StaticReadings

ZERO_STD = 2e-3
"""Least standard deviation of a position zero [rad]: links give way."""
SIGMA_SHARE = 2e-3
"""Standard deviation of a row about the model where the record has none, as a share of rated torque."""
ALIKE = 2.0
"""The variance of rows is multiplied by this to begin with: what the model lacks is alike in neighbouring rows. Then it
is measured."""
FITTED = 5
"""Rows of a joint that its own parameters take up."""
NEIGHBOUR_DISTANCE = 0.2
"""Rows of a joint are neighbours if it moved less between them [rad]."""
LEARNING_ROUNDS = 3
"""Linearisations of learning, each with the scatter found by the one before."""
UNKNOWN_WARMTH_STD = 0.01
"""Doubt of a gain where no temperature is known: a drive that warms by 10 K loses a hundredth."""
KNOWN_WARMTH_STD = 5e-4
"""Doubt of a gain where it is: drives tell whole kelvins."""


class MotorBelief:
    """Parameters and covariance of an arm's drives, and the standard deviation of a row."""

    def __init__(self, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated: Array) -> None:
        """Of records of creep sweeps; rated torques (n,) [N·m]."""
        self.arm, self.rated, n = arm, rated, arm.n
        doubt = MotorDoubt()  # of what the records do not hold
        motors = [_motor(joint.motor) for joint in calibration.joints]
        self._at = family_slices(n)
        self.mean = np.zeros(self._at["rho"].stop)
        std = np.zeros_like(self.mean)
        self.mean[self._at["gain"]] = 1.0
        std[self._at["gain"]], std[self._at["offset"]], zero = _sensors(calibration, rated, doubt)
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
        self.learnt: list[Passage] = []
        """Rows that the belief rests on, beside the records."""
        self._first = (self.mean, self.covariance, self.sigma)

    def rows(self, passages: Sequence[Passage]) -> StaticReadings:
        joint = np.array([each.joint for each in passages], dtype=np.int64)
        warm = np.array([each.temperature for each in passages]) - self.reference_temperature[joint]
        own = np.arange(self.arm.n) == joint[:, None]

        def of_own(values: Array) -> Array:
            return np.asarray(own * values[:, None])

        return StaticReadings(
            np.array([each.position for each in passages]).reshape(-1, self.arm.n),
            np.where(own, np.array([each.torque for each in passages])[:, None], np.nan),
            self.sigma,
            velocity=of_own(np.array([each.velocity for each in passages])),
            warmth=of_own(np.nan_to_num(warm)),
        )

    def linearised(self, passages: Sequence[Passage], carried: Array | None = None) -> tuple[Array, Array, Array]:
        """(Residuals (K,) [N·m], derivatives (K, P) of the readings, covariance (K, K) to expect of the residuals).

        `carried` (2n,) [kg·m] is added to the mass moments.
        """
        model, mean = MotorModel(self.arm, self.rows(passages)), self.mean
        if carried is not None:
            mean = mean.copy()
            mean[self._at["beta"]] += carried
        predicted, jacobian = model.linearised(mean)
        covariance = jacobian @ self.covariance @ jacobian.T
        covariance[np.diag_indices(len(jacobian))] += self.sigma[model.joint] ** 2
        untold = np.array([np.isnan(each.temperature - self.reference_temperature[each.joint]) for each in passages])
        by_gain = jacobian[:, self._at["gain"]] * np.where(untold, UNKNOWN_WARMTH_STD, KNOWN_WARMTH_STD)[:, None]
        return model.reading - predicted, jacobian, covariance + by_gain @ by_gain.T

    def learn(self, passages: Sequence[Passage]) -> Self:
        """The belief with more rows in which nothing has changed."""
        belief = copy(self)
        belief.learnt = [*self.learnt, *passages]
        first_mean, first_covariance, belief.sigma = self._first
        model = MotorModel(self.arm, self.rows(belief.learnt))
        belief.mean = first_mean
        for _ in range(LEARNING_ROUNDS):
            predicted, jacobian = model.linearised(belief.mean)
            noise = belief.sigma[model.joint] ** 2
            target = model.reading - predicted + jacobian @ (belief.mean - first_mean)
            of_mean = first_covariance @ jacobian.T
            gain = np.linalg.solve(jacobian @ of_mean + np.diag(noise), of_mean.T).T
            belief.mean = first_mean + gain @ target
            belief.covariance = first_covariance - gain @ of_mean.T
            belief.sigma = self._scatter(model, model.reading - model.predict(belief.mean))
        return belief

    def _scatter(self, model: MotorModel, residual: Array) -> Array:
        """Standard deviation of a row (n,) [N·m]: as measured, drawn towards what was assumed.

        Neighbouring rows whose residuals are alike count for less than one each, as in `calib.fit.scatter`.
        """
        usual, found = self._first[2], np.empty(self.arm.n)
        for j in range(self.arm.n):
            own = np.flatnonzero(model.joint == j)
            square = residual[own] ** 2
            variance = (square.sum() + NOISE_ROWS * usual[j] ** 2) / (max(len(own) - FITTED, 0) + NOISE_ROWS)
            near = np.abs(np.diff(model.readings.position[own, j])) < NEIGHBOUR_DISTANCE
            common = float((residual[own][1:] * residual[own][:-1])[near].sum() / max(square[1:][near].sum(), 1e-12))
            found[j] = np.sqrt(variance * (1 + 2 * min(max(common, 0.0), 1.0)))
        return found

    def gravity_torque(self, position: Array) -> Array:
        """Gravity torque (K, n) [N·m] at angles (K, n)."""
        torque: Array = gravity_regressor(self.arm, position) @ self.mean[self._at["beta"]]
        return torque


def _motor(motor: MotorTorque | None) -> MotorTorque:
    """A joint without a record of friction, which did not creep, may have any."""
    nothing = (0.0, 0.0)
    return motor or MotorTorque(coulomb=nothing, load=nothing, viscous=nothing, asymmetry=nothing)


def _sensors(calibration: CalibrationRecord, rated: Array, doubt: MotorDoubt) -> tuple[Array, Array, Array]:
    """Standard deviations (n,) of relative gains, of offsets [N·m] and of zeros [rad]; where one is not known, what is
    assumed before any sweep."""
    known = {name: float(row[at]) ** 0.5 for at, (name, row) in enumerate(
        zip(calibration.covariance_of, calibration.covariance, strict=True))}  # fmt: skip
    gain, offset, zero = (np.empty(len(rated)) for _ in range(3))
    for j, joint in enumerate(calibration.joints):
        gain[j] = known.get(f"{joint.name}.gain", doubt.gain) / abs(joint.gain or 1.0)
        offset[j] = known.get(f"{joint.name}.offset", doubt.offset_share * rated[j]) / abs(joint.gain or 1.0)
        zero[j] = known.get(f"{joint.name}.position_offset", 0.0)
    return gain, offset, zero
