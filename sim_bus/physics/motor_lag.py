"""Motors with delayed torque: a dead time, then a first-order lag."""

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections


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
