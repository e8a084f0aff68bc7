"""The belief about an arm before its own work is seen: its records, its model, and what sound arms lack."""

from dataclasses import dataclass, replace

import numpy as np

from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.external.external_model import ArmPrior
from gcomp.external.filtered_rows import JOINT_COLUMNS, WAVES
from gcomp.external.rigid_motion import LINK_PARAMETERS, gravity_split
from gcomp.identify.motor_model import MotorDoubt

LEAST_MASS = 0.02
"""Of the arm's mass: what a link that the model leaves out may have."""
LEAST_REACH = 0.05
"""Distance of a link's mass from its axis, at least [m]."""
MASS_DOUBT, PLACE_DOUBT = 0.2, 0.3
"""Standard deviations of a model's masses, as a share, and of centres and radii of gyration, as a share of a link's
length; a choice, which a baseline corrects."""


_MOTOR = MotorDoubt()


@dataclass(frozen=True)
class JointDoubt:
    """Standard deviations of a joint's own parameters; torques as shares of the joint's scale, the others per SI."""

    offset: float
    coulomb: float
    load: float
    viscous: float
    rotor: float
    gain: float
    waves: float
    noise: float

    def std(self, scale: Array) -> Array:
        """(n, C) as in `gcomp.external.filtered_rows`."""
        of = {
            "offset": self.offset * scale,
            "coulomb": self.coulomb * scale,
            "coulomb_wide": 0.5 * self.coulomb * scale,
            "breakaway": 0.3 * self.coulomb * scale,
            "load": self.load + 0.0 * scale,
            "viscous": self.viscous * scale,
            "quadratic": self.viscous * scale,
            "uneven_cos": 0.2 * self.coulomb * scale,
            "uneven_sin": 0.2 * self.coulomb * scale,
            "warm_coulomb": 0.02 * self.coulomb * scale,
            "warm_viscous": 0.02 * self.viscous * scale,
            "warm_offset": 1e-3 * self.offset * scale,
            "warm_gain": _MOTOR.warming + 0.0 * scale,
            "rotor": self.rotor * scale,
            "gain": self.gain + 0.0 * scale,
        }
        own = np.stack([of[name] for name in JOINT_COLUMNS], axis=-1)
        return np.hstack([own, np.repeat(self.waves * scale[:, None], WAVES, axis=1)])


MOTOR = JointDoubt(
    _MOTOR.offset_share, _MOTOR.coulomb_share, _MOTOR.load, 5 * _MOTOR.viscous_share, 0.05, 0.15, 0.02, 0.03
)
"""Torque that is a motor current, as of a fit of creeping joints; rotors take up to a twentieth of rated torque per
rad/s²."""
LINK = JointDoubt(0.03, 0.03, 0.02, 0.02, 0.002, 0.05, 0.01, 0.01)
"""Torque of a sensor beyond the transmission: bearings, seals and cables alone rub."""


def prior_of_model(arm: Arm, links: Array, doubt: JointDoubt, scale: Array) -> ArmPrior:
    """Of inertials (n, 10) in bar frames that nothing has confirmed."""
    n = arm.n
    mass = np.maximum(links[:, 0], LEAST_MASS * links[:, 0].sum())
    reach = np.maximum(np.linalg.norm(arm.span, axis=1), LEAST_REACH)
    std = np.empty((n, LINK_PARAMETERS))
    std[:, 0] = MASS_DOUBT * mass
    std[:, 1:4] = (PLACE_DOUBT * mass * reach)[:, None]
    std[:, 4:] = (PLACE_DOUBT * mass * reach**2)[:, None]
    back = np.linalg.inv(gravity_split(arm)) * std.ravel()
    joints_std = doubt.std(scale)
    return ArmPrior(links, back @ back.T, np.zeros_like(joints_std), joints_std, doubt.noise * scale)


def with_gravity(prior: ArmPrior, arm: Arm, gravity: GravityRecord, beta: Array) -> ArmPrior:
    """With a record's mass moments in place of those of the links, `beta` (2 n,)."""
    n = arm.n
    links, covariance = prior.links.copy(), prior.covariance.copy()
    links[:, 1:3] += (np.array(gravity.beta) - beta).reshape(n, 2)
    covariance[: 2 * n] = covariance[:, : 2 * n] = 0.0
    covariance[: 2 * n, : 2 * n] = np.array(gravity.covariance)
    return replace(prior, links=links, covariance=covariance)


def with_calibration(prior: ArmPrior, calibration: CalibrationRecord) -> ArmPrior:
    """With a record's friction, and how sure it is of gains and offsets."""
    mean, std, noise = prior.joints.copy(), prior.joints_std.copy(), prior.noise.copy()
    at = {name: k for k, name in enumerate(JOINT_COLUMNS)}
    gain, offset = calibration.std("gain"), calibration.std("offset")
    level = calibration.discrepancy("level")
    for j, joint in enumerate(calibration.joints):
        size = abs(joint.gain or 1.0)
        if np.isfinite(gain[j]):
            std[j, at["gain"]] = gain[j] / size
        if np.isfinite(offset[j]):
            std[j, at["offset"]] = offset[j] / size
        if joint.residual_std is not None:
            noise[j] = joint.residual_std / size
        if level[j] > 0.0:
            std[j, len(at) :] = level[j]
        if joint.motor is not None:
            for name in ("coulomb", "load", "viscous"):
                mean[j, at[name]], std[j, at[name]] = getattr(joint.motor, name)
    return replace(prior, joints=mean, joints_std=std, noise=noise)
