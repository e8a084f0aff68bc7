"""Rows of motion of drives whose torque is a motor current, and the belief about these: friction, gravity, doubts.

Where torque is a motor current, friction hides gravity at rest; while a joint moves, friction has a known sign. A row
is a passage: the averages over a stretch of ordinary motion in which a joint moves at constant speed. A stretch counts
only if no joint of the arm speeds up or slows down in it, so that inertia takes no torque.

The unknowns are those of `gcomp.identify.motor_model`, against readings that are corrected by the record in force:
gains are 1 and offsets 0 while nothing has changed. Records say how sure each value is, though not how gains and
mass moments go together, nor how friction changes over position: that is learned from work in which nothing changed.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from calib.fit.calibration import NOISE_ROUNDS, USUAL_ROWS
from calib.motion.static_reading import LEAST_SAMPLES, slope
from calib.observer.config import LONGEST_GAP, PLACE_SIZE
from calib.observer.saved_values import known
from calib.records.records import CalibrationRecord, GravityRecord, MotorTorque, Parameter
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.motor_model import LAST_ZERO, MotorDoubt, MotorModel, family_slices
from gcomp.identify.readings import StaticReadings

WIDTH = 0.1
"""A stretch is complete when some joint has moved this far [rad]: two or three periods of a motor's cogging."""
LEAST_SECONDS, MOST_SECONDS = 0.2, 3.0
"""Shortest and longest stretch [s]: a slower joint creeps below the speeds at which its friction is known."""
SLOWEST = 0.03
"""Below this speed friction depends on the time at rest [rad/s]: such a joint gives no row."""
STEADY = 0.15
"""Largest acceleration in a stretch [rad/s²]: 1 kg·m² then takes 0.15 N·m."""
TURNED = 0.03
"""After a reversal friction has turned round once the joint has moved so far [rad]."""


@dataclass(frozen=True, eq=False)
class Passage:
    """One joint's averages over a stretch of motion."""

    t: float
    """Middle of the stretch [s]."""
    joint: int
    position: Array
    """Of all joints (n,) [rad]."""
    torque: float
    """Of this joint's motor [N·m]."""
    velocity: float
    """Of this joint, with sign [rad/s]."""
    temperature: float
    """Of its drive [°C]; NaN if it is not known."""

    def to_json(self) -> list[Any]:
        """As JSON values, without the time, since clocks restart with the machine."""
        warm = known(np.array([self.temperature]))[0]
        return [self.joint, self.position.tolist(), self.torque, self.velocity, warm]

    @classmethod
    def from_json(cls, values: Any, n: int) -> "Passage":
        """Read back; raises TypeError, ValueError or LookupError where the values do not fit n joints."""
        joint, position, torque, velocity, warm = values
        if not 0 <= int(joint) < n:
            raise ValueError(f"joint {joint} of {n}")
        temperature = np.nan if warm is None else float(warm)
        where = as_array("position", position, (n,))
        return cls(0.0, int(joint), where, float(torque), float(velocity), temperature)


@dataclass
class PassageDetector:
    """Cuts samples of an arm of n joints into stretches, and averages the steady ones."""

    n: int
    _samples: list[tuple[float, Array, Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._side = np.zeros(self.n)
        self._turned_at = np.full(self.n, np.nan)

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Passage]:
        """Take one sample ((n,) each, SI, temperatures in °C); the rows of the stretch that it completes."""
        if not (np.isfinite(position).all() and np.isfinite(torque).all()):
            self._samples.clear()
            return []
        if self._samples and not 0 < t - self._samples[-1][0] <= LONGEST_GAP:
            self._samples.clear()
        self._samples.append((t, position.copy(), torque.copy()))
        first = self._samples[0]
        if np.abs(position - first[1]).max() < WIDTH or t - first[0] < LEAST_SECONDS:
            if t - first[0] > MOST_SECONDS:
                self._samples = [self._samples[-1]]
            return []
        rows = self._rows(np.full(self.n, np.nan) if temperature is None else temperature)
        self._samples = [self._samples[-1]]
        return rows

    def _rows(self, temperature: Array) -> list[Passage]:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        if len(times) < LEAST_SAMPLES:
            return []
        half = len(times) // 2
        early, late = slope(times[: half + 1], positions[: half + 1]), slope(times[half:], positions[half:])
        velocity = (positions[-1] - positions[0]) / (times[-1] - times[0])
        side = np.where(np.abs(velocity) >= SLOWEST, np.sign(velocity), 0.0)
        turned = (side != 0) & (side != self._side)
        self._turned_at = np.where(turned, positions[0], self._turned_at)
        self._side = np.where(side != 0, side, self._side)
        if (np.abs(late - early) > STEADY * (times[-1] - times[0]) / 2).any():
            return []
        onward = (np.sign(early) == side) & (np.sign(late) == side)
        settled = np.abs(positions[0] - self._turned_at) >= TURNED
        weight = np.hanning(len(times) + 2)[1:-1]  # suppresses ripple with the position
        weight /= weight.sum()
        here, pull, when = weight @ positions, weight @ torques, float(weight @ times)
        return [
            Passage(when, int(j), here, float(pull[j]), float(velocity[j]), float(temperature[j]))
            for j in np.flatnonzero((side != 0) & onward & settled)
        ]


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
        for _ in range(NOISE_ROUNDS):
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

    def gravity_torque(self, position: Array) -> Array:
        """Gravity torque (K, n) [N·m] at angles (K, n)."""
        return gravity_regressor(self.arm, position) @ self.mean[self._at["beta"]]


def _known_std(calibration: CalibrationRecord, parameter: Parameter, before: Array | float) -> Array:
    """Standard deviations (n,) of the record; where it has none, what is assumed before any sweep."""
    std = calibration.std(parameter)
    return np.where(np.isnan(std), before, std)
