"""What an arm's drives may do and where its stops are, as arrays."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class Limits:
    """What the drives may do, and where the stops are; all (n,)."""

    lower: Array
    upper: Array
    rated: Array
    max_torque: Array
    speed: Array

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
