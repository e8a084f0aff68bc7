"""A run of one arm on the plant, and the log that it returns."""

from dataclasses import dataclass

from gcomp.arrays import Array
from sim_gap.blind.cases.true_arm import TrueArm


@dataclass(frozen=True)
class Run:
    """One arm and the trajectory that it is to follow."""

    truth: TrueArm
    command: Array
    """Positions at `motion.RATE`, (K, n) [rad]."""
    feed_forward: Array
    """Nominal torque along the trajectory, (K, n) [N·m]."""
    inertia: Array
    """Inertia of each joint for the controller's gains (n,) [kg·m²]."""
    seed: int


@dataclass(frozen=True)
class Log:
    """Time series at `motion.RATE`, (K, n) each, before the sensors; `position` is the angle on the encoder's side."""

    position: Array
    torque: Array
    """Link side of the transmission [N·m]."""
    motor: Array
    """Torque that the drive estimates [N·m]."""
    command: Array
    angle: Array
    """Angles of the links [rad]."""
