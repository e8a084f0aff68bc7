"""The rough gravity model from the scout's static readings, and the levers of gravity and of the reference mass.

The model is sufficient for bias torques that hold safely; without a lever no creep tells a torque constant.
"""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import model_arm
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.estimate.posterior import linear_posterior
from gcomp.gravity.torque import gravity_levers, gravity_regressor

GAIN_STD = 0.3
"""Standard deviation of an uncalibrated torque gain; tests/calib/drawn_arms.py draws 0.7 to 1.3."""
MODEL_ERROR = 0.1
"""Standard deviation of a model file's mass moments, as a share of each; a choice."""
HAND = 0.15
"""Largest distance of the reference mass from the flange [m], as in tests/calib/drawn_arms.py."""
BOUND_DEVIATIONS = 3.0
"""Standard deviations of the rough model that its bounds include: 99.7 %."""


@dataclass(frozen=True, eq=False)
class GravityGuess:
    """Rough mass moments, in the scale of the drives' torque, which is that of the commands."""

    kinematics: Arm
    beta: Array
    """(2n,) [kg·m]"""
    covariance: Array
    """(2n, 2n)"""

    def torque(self, q: Array) -> Array:
        """Holding torque (…, n) [N·m] at poses q (…, n) [rad]."""
        return gravity_regressor(self.kinematics, q) @ self.beta

    def uncertainty(self, q: Array) -> Array:
        """Bound of the model's error (…, n) [N·m] at poses q (…, n) [rad]."""
        regressor = gravity_regressor(self.kinematics, q)
        variance = np.einsum("...ip,pq,...iq->...i", regressor, self.covariance, regressor, optimize=True)
        return np.asarray(BOUND_DEVIATIONS * np.sqrt(np.maximum(variance, 0.0)))

    def inertia(self) -> Array:
        """Rough upper size (n,) [kg·m²] of each joint's inertia: composite mass moment times reach."""
        moment = np.linalg.norm(self.beta.reshape(-1, 2), axis=1)[::-1].cumsum()[::-1]
        return np.asarray(moment * reach(self.kinematics))


def guess_of_model(kinematics: Arm, beta: Array) -> GravityGuess:
    """Mass moments β (2n,) [kg·m] of a model file, each taken as known to a tenth."""
    size = np.maximum(np.abs(beta), np.abs(beta).max(initial=0.0) / 20)
    return GravityGuess(kinematics, beta, np.diag((MODEL_ERROR * size) ** 2))


def guess_of_file(arm_file: ArmFile) -> GravityGuess | None:
    """That of an arm file's model; None where it has none. Raises BadInput."""
    if arm_file.model_path is None:
        return None
    model = model_arm(arm_file)
    return guess_of_model(model.arm, model.beta)


def reach(kinematics: Arm, hand: float = HAND) -> Array:
    """Largest distance (n,) [m] from each joint to the far side of a hand of size `hand` [m]."""
    length: Array = np.linalg.norm(kinematics.span, axis=1)
    return length[::-1].cumsum()[::-1] + hand


def guess_gravity(
    kinematics: Arm, position: Array, torque: Array, motor_torque: Array, rated: Array, friction: float
) -> GravityGuess:
    """Rough mass moments from servo-held poses: positions, sensor readings, drive torques, all (P, n).

    Linear least squares on κ v − ω = Y β and τ_motor = Y β, with κ = 1/gain near 1; `friction`, a share of rated
    torque (n,) [N·m], is the error allowed for the drives' torque. A worse fit enlarges the covariance.
    """
    poses, n = position.shape
    regressor = gravity_regressor(kinematics, position)
    sensor_rows = np.zeros((poses, n, 4 * n))
    motor_rows = np.zeros((poses, n, 4 * n))
    joints = np.arange(n)
    sensor_rows[:, joints, joints] = torque
    sensor_rows[:, joints, n + joints] = -1.0
    sensor_rows[:, :, 2 * n :] = -regressor
    motor_rows[:, :, 2 * n :] = regressor
    sensor_sigma, motor_sigma = 0.005 * rated, friction * rated
    largest_moment = (
        2 * float(rated.max()) / max(float(np.linalg.norm(kinematics.gravity)), 1.0)
    )  # that drives can hold
    spread = np.concatenate([np.full(n, GAIN_STD), 0.3 * rated, np.full(2 * n, largest_moment)])
    expected = np.concatenate([np.ones(n), np.zeros(3 * n)])
    counted = np.isfinite(motor_torque)
    columns = np.concatenate(
        [(sensor_rows / sensor_sigma[:, None]).reshape(-1, 4 * n), (motor_rows / motor_sigma[:, None])[counted]]
    )
    target = np.concatenate([np.zeros(poses * n), (motor_torque / motor_sigma)[counted]])
    fit = linear_posterior(columns, target, expected, spread)
    excess = max(fit.chi2 / len(target), 1.0)
    return GravityGuess(kinematics, fit.x[2 * n :], fit.covariance[2 * n :, 2 * n :] * excess)


VERTICAL = (
    "its axis is vertical in every pose, so gravity does not load it and its torque constant cannot be "
    "determined; mount the base tilted by 10° or more and write the tilt as kinematics.gravity"
)
NO_LEVER = (
    "the axes of all joints that gravity loads meet (nearly) in one point, so the distance of the mass from them is "
    "unknown, and all torque constants share one unknown factor; measure where the mass hangs (sweep.reference_point)"
)
SHORTEST = 0.005
"""Lever below which the place of the mass hides it [m], root mean square over poses."""


def is_vertical(arm: Arm, joint: int) -> bool:
    """Whether a joint's axis is along gravity in every pose."""
    poses = np.random.default_rng(1).uniform(-1.5, 1.5, (20, arm.n))
    return bool(np.all(gravity_levers(arm, poses)[:, joint] < 0.02 * np.linalg.norm(arm.gravity)))


def known_lever(arm: Arm) -> float:
    """Lever of a mass whose place on the last link is not known [m]: what the place cannot take up, RMS over poses."""
    rest = known_torques(arm, np.random.default_rng(1).uniform(-1.5, 1.5, (50, arm.n)))
    return float(np.sqrt(np.mean(rest**2)) / np.linalg.norm(arm.gravity))


def known_torques(arm: Arm, poses: Array) -> Array:
    """Torques (K n,) [N·m] of 1 kg at poses (K, n) [rad] that its place on the last link cannot take up."""
    regressor, (at_origin, by_point) = gravity_regressor(arm, poses), payload_columns(arm)
    torque, moved = (regressor @ at_origin).ravel(), (regressor @ by_point).reshape(-1, 3)
    return np.asarray(torque - moved @ np.linalg.lstsq(moved, torque, rcond=None)[0])
