"""Dry friction of transmissions: its level from velocity, direction and load."""

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

RESTING = 1e-4
"""Below this velocity a joint is at rest, and the motor torque gives its direction [rad/s]."""


def dry_friction(state: Imperfections, velocity: Array, load: Array, motor_torque: Array) -> Array:
    """Friction that opposes the motors' `velocity` [rad/s] while they transmit `load` [N·m] → (n,) [N·m]."""
    level = state.coulomb + state.breakaway * np.exp(-((velocity / state.stribeck_velocity) ** 2))
    level = level + state.load_friction * np.abs(load)
    heading = np.where(np.abs(velocity) < RESTING, np.sign(motor_torque - load), np.sign(velocity))
    return np.asarray(np.maximum(level * (1.0 + state.asymmetry * heading), 0.0))
