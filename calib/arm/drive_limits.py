"""Joint range and drive limits of an arm as arrays."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm

Array = npt.NDArray[np.float64]


def rated_torques(arm: ArmFile) -> Array:
    """Rated torque of every joint (n,) [N·m]; raises BadInput if the arm file has no link section."""
    return np.array([joint.rated_torque for joint in arm.require_link().joints])


@dataclass(frozen=True, eq=False)
class Limits:
    """Stops, and what the drives are capable of; all (n,)."""

    lower: Array
    """[rad]"""
    upper: Array
    """[rad]"""
    rated: Array
    """[N·m]"""
    max_torque: Array
    """[N·m]"""
    speed: Array
    """[rad/s]"""

    @classmethod
    def of(cls, arm: ArmFile) -> "Limits":
        """From the arm file's link section and joint range."""
        described, joints = gcomp_arm(arm), arm.require_link().joints
        return cls(
            described.lower,
            described.upper,
            rated_torques(arm),
            np.array([joint.max_torque for joint in joints]),
            np.array([joint.max_velocity for joint in joints]),
        )
