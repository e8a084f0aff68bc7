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


def unevenness(state: Imperfections, position: Array, velocity: Array, load: Array, time: float) -> Array:
    """Friction (n,) [N·m] added by position [rad], direction of motion, transmitted torque `load` [N·m] and a cold gear
    at `time` [s]."""
    amplitude, phase, by_load, cold = state.uneven.T
    factor = (1 + amplitude * np.sin(position + phase)) * (1 + cold * coldness(state, time))
    level = state.coulomb * factor + by_load * np.abs(load)
    added: Array = level * (1 + state.leaning * np.sign(velocity)) - state.coulomb
    return added


def coldness(state: Imperfections, time: float) -> Array:
    """How cold each joint still is (n,), 1 at power-on and 0 when warm."""
    constant = state.warm_up[:, 1]
    cold: Array = np.exp(-time / np.where(constant > 0, constant, np.inf))
    return np.where(constant > 0, cold, 0.0)
