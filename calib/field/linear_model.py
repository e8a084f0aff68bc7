"""Linear problem of the field calibration: prior, columns, and least squares with that prior."""

from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.fit.position_field import PositionField
from calib.records.records import CalibrationRecord, Discrepancy, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.readings import StaticReadings

HYSTERESIS = 0.01
"""Prior standard deviation of f_i, as a share of rated torque (docs/theory.md, section 4.3)."""
UNKNOWN_MOMENT = 10.0
"""Prior standard deviation of a mass moment that is not identifiable in the gravity record [kg·m]."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Prior knowledge, from the records."""

    arm: Arm
    rated: Array
    beta: Array
    root: Array
    """(2n, P): Cov β̂ = root rootᵀ."""
    position_gain: Array
    position_offset: Array
    position_std: Array
    installed: TorqueCalibration[Array]
    """The current record's (n,)."""
    spread: tuple[Array, Array] | None
    """Its standard deviations of gain and offset (n,), NaN if unknown; None without a record."""
    discrepancy: tuple[Discrepancy | None, ...]
    """Disagreement of that record's calibrated torque with the gravity model, joint by joint."""
    local: Array
    """Columns of the discrepancy, each of unit standard deviation, at the rows (K, n, F) [N·m]; see `over`."""

    def over(self, rows: StaticReadings, q: Array) -> "Belief":
        """The same with the discrepancy expanded over rows at true angles q (K, n) [rad]."""
        parts = []
        for joint, each in enumerate(self.discrepancy):
            counted = np.isfinite(rows.torque[:, joint])
            if each is None or each.level == 0 or not counted.any():
                continue
            columns = each.level * PositionField.over(q[counted], each.length).columns(q)
            parts.append(columns[:, None, :] * (np.arange(len(self.rated)) == joint)[:, None])
        empty = np.zeros((len(q), len(self.rated), 0))
        return replace(self, local=np.concatenate([empty, *parts], axis=2))

    def prior(self, gain_share: Array) -> tuple[Array, Array]:
        """(mean, std) of all parameters: gains around the installed ones within a share of them, offsets unknown."""
        return self._prior(gain_share * np.abs(self.installed.gain), 10 * self.rated)

    def prior_installed(self) -> tuple[Array, Array]:
        """(mean, std) of all parameters, gains and offsets as in the current record."""
        of_gain, of_offset = self.spread or (np.zeros_like(self.rated), np.zeros_like(self.rated))
        tight = np.fmax(of_gain, 1e-3 * np.abs(self.installed.gain)), np.fmax(of_offset, 1e-3 * self.rated)
        return self._prior(*tight)

    def _prior(self, gain_std: Array, offset_std: Array) -> tuple[Array, Array]:
        others = self.root.shape[1] + len(self.rated) + self.local.shape[2]
        zeros = np.zeros(len(self.rated) + others)
        return (
            np.concatenate([self.installed.gain, self.installed.offset, zeros]),
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
    """Parameters (p,) of torque = columns @ parameters, columns (K, n, p), prior (mean, std); NaN rows are left out."""
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
    """From the records; raises Refused if one is of another arm."""
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
    blank = per_joint([UNCALIBRATED] * n)
    spread = None if calibration is None else (calibration.std("gain"), calibration.std("offset"))
    return Belief(
        arm=described,
        rated=arm.require_link().rated_torques,
        beta=np.array(gravity.beta),
        root=np.hstack([root, unknown]),
        position_gain=np.ones(n) if calibration is None else calibration.values("position_gain", 1.0),
        position_offset=np.zeros(n) if calibration is None else calibration.values("position_offset", 0.0),
        position_std=np.maximum(zero_std, 1e-6),
        installed=blank if calibration is None else calibration.torque_calibration(blank),
        spread=spread,
        discrepancy=(None,) * n if calibration is None else tuple(each.discrepancy for each in calibration.joints),
        local=np.zeros((0, n, 0)),
    )


def field_columns(belief: Belief, rows: StaticReadings, q: Array, gain: Array) -> Array:
    """Columns (K, n, p): gains, offsets, hysteresis, β in units of its root, position offsets in units of their std,
    and the discrepancy in units of its level.
    """
    n, each = belief.arm.n, np.eye(belief.arm.n)
    regressor = gravity_regressor(belief.arm, q)
    torque = regressor @ belief.beta
    stiffness = gravity_stiffness(belief.arm, belief.beta, q) * belief.position_std
    by_joint = [each * torque[:, :, None], np.broadcast_to(each, (len(q), n, n)), each * rows.direction[:, :, None]]
    scaled = gain[:, None]
    beyond = [scaled * (regressor @ belief.root), scaled * stiffness, scaled * belief.local]
    return np.concatenate([*by_joint, *beyond], axis=2)
