"""The field calibration's linear problem: what is believed beforehand, its columns, and least squares with a prior."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.records.records import PARAMETERS, Array, CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

HYSTERESIS = 0.01
"""Standard deviation of f_i believed beforehand, as a share of rated torque."""
UNKNOWN_MOMENT = 10.0
"""Standard deviation of a mass moment that the gravity record could not determine [kg·m]."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known before the rows are looked at."""

    arm: Arm
    rated: Array
    beta: Array
    root: Array
    """(2n, P): Cov β̂ = root rootᵀ."""
    position_gain: Array
    position_offset: Array
    position_std: Array
    installed: tuple[Array, Array]
    """Gain and offset of the record in force (n,)."""
    spread: tuple[Array, Array] | None
    """Their standard deviations (n,), NaN where not known; None where there is no record."""

    def prior(self, gain_share: Array) -> tuple[Array, Array]:
        """(mean, std) of all parameters with gains around those in force by a share of them, offsets unknown."""
        gain, offset = self.installed
        return self._prior(gain_share * np.abs(gain), 10 * self.rated, (gain, offset))

    def prior_installed(self) -> tuple[Array, Array]:
        """(mean, std) with gains and offsets as the record in force has them."""
        gain, offset = self.installed
        of_gain, of_offset = self.spread or (np.zeros_like(gain), np.zeros_like(offset))
        tight = np.fmax(of_gain, 1e-3 * np.abs(gain)), np.fmax(of_offset, 1e-3 * self.rated)
        return self._prior(*tight, (gain, offset))

    def _prior(self, gain_std: Array, offset_std: Array, mean: tuple[Array, Array]) -> tuple[Array, Array]:
        others = self.root.shape[1] + len(self.rated)
        zeros = np.zeros(len(self.rated) + others)
        return (
            np.concatenate([*mean, zeros]),
            np.concatenate([gain_std, offset_std, HYSTERESIS * self.rated, np.ones(others)]),
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """Weighted least squares with a normal prior."""

    value: Array
    covariance: Array
    chi2: float
    """Of rows and prior together."""


def solve(columns: Array, torque: Array, sigma: Array, prior: tuple[Array, Array]) -> Solution:
    """Parameters (p,) of torque = columns @ parameters, columns (K, n, p), prior (mean, std); NaN is left out."""
    counted = np.isfinite(torque)
    design = columns[counted] / sigma[counted][:, None]
    target = torque[counted] / sigma[counted]
    mean, std = prior
    scaled = np.vstack([design * std, np.eye(len(std))])  # in standard deviations of the prior
    triangle = np.linalg.qr(scaled, mode="r")
    inverse = np.linalg.inv(triangle)
    covariance = (std[:, None] * (inverse @ inverse.T)) * std
    change = std * (inverse @ (inverse.T @ (std * (design.T @ (target - design @ mean)))))
    left = target - design @ (mean + change)
    return Solution(mean + change, covariance, float(left @ left + np.sum((change / std) ** 2)))


def belief_of(arm: ArmFile, gravity: GravityRecord, calibration: CalibrationRecord | None) -> Belief:
    """From the records; raises Refused where one is of another arm."""
    described, n = gcomp_arm(arm), len(arm.joint_names)
    values, vectors = np.linalg.eigh(np.array(gravity.require(arm).covariance))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    lost = np.flatnonzero(~np.array(gravity.identifiable))
    unknown = np.zeros((2 * n, len(lost)))
    unknown[lost, np.arange(len(lost))] = UNKNOWN_MOMENT
    zero_std = np.full(n, sweep_section(arm).position_offset_std)
    if calibration is not None:
        calibration.require(arm)
        zero_std = np.where(np.isnan(calibration.std("position_offset")), zero_std, calibration.std("position_offset"))
    values_of = {}
    for name in PARAMETERS:
        default = 1.0 if name.endswith("gain") else 0.0
        values_of[name] = np.full(n, default) if calibration is None else calibration.values(name, default)
    spread = None if calibration is None else (calibration.std("gain"), calibration.std("offset"))
    return Belief(
        arm=described,
        rated=np.array([joint.rated_torque for joint in arm.require_link().joints]),
        beta=np.array(gravity.beta),
        root=np.hstack([root, unknown]),
        position_gain=values_of["position_gain"],
        position_offset=values_of["position_offset"],
        position_std=np.maximum(zero_std, 1e-6),
        installed=(values_of["gain"], values_of["offset"]),
        spread=spread,
    )


def field_columns(belief: Belief, rows: StaticReadings, q: Array, gain: Array) -> Array:
    """(K, n, p): by gain, offset, hysteresis of each joint, by β in units of its root, by position offsets [std]."""
    n, each = belief.arm.n, np.eye(belief.arm.n)
    regressor = gravity_regressor(belief.arm, q)
    torque = regressor @ belief.beta
    stiffness = gravity_stiffness(belief.arm, belief.beta, q) * belief.position_std
    by_joint = [each * torque[:, :, None], np.broadcast_to(each, (len(q), n, n)), each * rows.direction[:, :, None]]
    scaled = gain[:, None]
    return np.concatenate([*by_joint, scaled * (regressor @ belief.root), scaled * stiffness], axis=2)
