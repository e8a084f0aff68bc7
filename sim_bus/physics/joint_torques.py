"""Torques on joints beside the motors' demands: dry friction, cables along the arm, motors that are late."""

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


class Cables:
    """Cables of all joints with what they remember; arrays (n,)."""

    def __init__(self, state: Imperfections, middle: Array, position: Array) -> None:
        """Cables that have come to rest at `position`; `middle` is the middle of each joint's range [rad]."""
        n = len(middle)
        self._stiffness, share, self._rest, self._pull, self._lag = state.cable.T
        self._middle = middle
        self._bend = np.eye(n)
        if n > 1:
            self._bend[np.arange(n), [*range(1, n), n - 2]] += share
        self._play = self._bent(position)

    def torque(self, position: Array) -> Array:
        """Torque on each link (n,) [N·m] as the joints come to `position` [rad]."""
        bent, lag = self._bent(position), np.where(self._lag > 0, self._lag, np.inf)
        self._play = np.clip(self._play, bent - lag, bent + lag)
        pull = self._stiffness * bent + self._pull * (bent - self._play) / lag
        on_links: Array = -pull @ self._bend
        return on_links

    def _bent(self, position: Array) -> Array:
        bent: Array = self._bend @ (position - self._middle) - self._rest
        return bent


class LateMotors:
    """Turns demanded into actual torques, step by step; arrays (n,)."""

    def __init__(self, imperfections: Imperfections, torque: Array) -> None:
        """Motors that produce `torque` at the start [N·m]."""
        self._lag, self._delay = imperfections.actuator_lag, imperfections.actuator_delay
        self._made = torque / imperfections.actuator_gain
        self._time = 0.0
        self._asked: list[tuple[float, Array]] = [(0.0, self._made)]

    def torque(self, asked: Array, duration: float) -> Array:
        """Torque during the next `duration` [s], with `asked` demanded from now on."""
        due = self._delayed(asked)
        with np.errstate(divide="ignore"):
            share = np.where(self._lag > 0, 1.0 - np.exp(-duration / self._lag), 1.0)
        self._made = self._made + share * (due - self._made)
        self._time += duration
        return self._made

    def _delayed(self, asked: Array) -> Array:
        """Torque demanded `delay` ago, held between steps."""
        self._asked.append((self._time, asked))
        oldest = self._time - self._delay.max()
        while len(self._asked) > 1 and self._asked[1][0] <= oldest + 1e-12:
            del self._asked[0]
        times = np.array([time for time, _ in self._asked])
        places = np.searchsorted(times, self._time - self._delay + 1e-9, side="right") - 1
        return np.array([self._asked[max(place, 0)][1][joint] for joint, place in enumerate(places)])
