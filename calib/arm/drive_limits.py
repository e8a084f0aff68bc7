"""Joint range and drive limits of an arm as arrays."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from gcomp.arrays import Array


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
        described, link = gcomp_arm(arm), arm.require_link()
        return cls(
            described.lower,
            described.upper,
            link.rated_torques,
            np.array([joint.max_torque for joint in link.joints]),
            np.array([joint.max_velocity for joint in link.joints]),
        )
