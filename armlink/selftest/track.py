"""Readings and commands of one joint, as the judgement of its scales takes them."""

from dataclasses import dataclass

from armlink.arrays import Array


@dataclass(frozen=True, eq=False)
class ScaleTrack:
    """Readings of one joint and what was commanded at the time, all (K,), NaN where there was none."""

    t: Array
    """[s]."""
    position: Array
    """[rad]."""
    velocity: Array
    """[rad/s]."""
    torque: Array
    """Motor torque as the drive reports it [N·m], no calibration applied."""
    target: Array
    """Commanded position [rad]."""
    rate: Array
    """Commanded velocity [rad/s]."""
    ahead: Array
    """Commanded torque [N·m]."""
    kp: Array
    """[N·m/rad]."""
    kd: Array
    """[N·m·s/rad]."""
