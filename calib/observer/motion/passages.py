"""Passages: stretches of ordinary motion in which a joint moves at constant speed, one averaged row each.

Where torque is a motor current, friction hides gravity at rest; while a joint moves, friction has a known sign. A
stretch counts only if no joint of the arm speeds up or slows down in it, so that inertia takes no torque.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.observer.config import LONGEST_GAP
from calib.observer.saved_values import known
from gcomp.arrays import Array, as_array

WIDTH = 0.1
"""A stretch is complete when some joint has moved this far [rad]: two or three periods of a motor's cogging."""
LEAST_SECONDS, MOST_SECONDS = 0.2, 3.0
"""Shortest and longest stretch [s]: a slower joint creeps below the speeds at which its friction is known."""
LEAST_SAMPLES = 8
"""Samples that a stretch has at least."""
SLOWEST = 0.03
"""Below this speed friction depends on the time at rest [rad/s]: such a joint gives no row."""
STEADY = 0.15
"""Largest acceleration in a stretch [rad/s²]: 1 kg·m² then takes 0.15 N·m."""
TURNED = 0.03
"""After a reversal friction has turned round once the joint has moved so far [rad]."""


@dataclass(frozen=True, eq=False)
class Passage:
    """One joint's averages over a stretch of motion."""

    t: float
    """Middle of the stretch [s]."""
    joint: int
    position: Array
    """Of all joints (n,) [rad]."""
    torque: float
    """Of this joint's motor [N·m]."""
    velocity: float
    """Of this joint, with sign [rad/s]."""
    temperature: float
    """Of its drive [°C]; NaN if it is not known."""

    def to_json(self) -> list[Any]:
        """As JSON values, without the time, since clocks restart with the machine."""
        warm = known(np.array([self.temperature]))[0]
        return [self.joint, self.position.tolist(), self.torque, self.velocity, warm]

    @classmethod
    def from_json(cls, values: Any, n: int) -> "Passage":
        """Read back; raises TypeError, ValueError or LookupError where the values do not fit n joints."""
        joint, position, torque, velocity, warm = values
        if not 0 <= int(joint) < n:
            raise ValueError(f"joint {joint} of {n}")
        temperature = np.nan if warm is None else float(warm)
        where = as_array("position", position, (n,))
        return cls(0.0, int(joint), where, float(torque), float(velocity), temperature)


@dataclass
class PassageDetector:
    """Cuts samples of an arm of n joints into stretches, and averages the steady ones."""

    n: int
    _samples: list[tuple[float, Array, Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._side = np.zeros(self.n)
        self._turned_at = np.full(self.n, np.nan)

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Passage]:
        """Take one sample ((n,) each, SI, temperatures in °C); the rows of the stretch that it completes."""
        if not (np.isfinite(position).all() and np.isfinite(torque).all()):
            self._samples.clear()
            return []
        if self._samples and not 0 < t - self._samples[-1][0] <= LONGEST_GAP:
            self._samples.clear()
        self._samples.append((t, position.copy(), torque.copy()))
        first = self._samples[0]
        if np.abs(position - first[1]).max() < WIDTH or t - first[0] < LEAST_SECONDS:
            if t - first[0] > MOST_SECONDS:
                self._samples = [self._samples[-1]]
            return []
        rows = self._rows(np.full(self.n, np.nan) if temperature is None else temperature)
        self._samples = [self._samples[-1]]
        return rows

    def _rows(self, temperature: Array) -> list[Passage]:
        times, positions, torques = (np.array(column) for column in zip(*self._samples, strict=True))
        if len(times) < LEAST_SAMPLES:
            return []
        half = len(times) // 2
        early, late = _speed(times[: half + 1], positions[: half + 1]), _speed(times[half:], positions[half:])
        velocity = (positions[-1] - positions[0]) / (times[-1] - times[0])
        side = np.where(np.abs(velocity) >= SLOWEST, np.sign(velocity), 0.0)
        turned = (side != 0) & (side != self._side)
        self._turned_at = np.where(turned, positions[0], self._turned_at)
        self._side = np.where(side != 0, side, self._side)
        if (np.abs(late - early) > STEADY * (times[-1] - times[0]) / 2).any():
            return []
        onward = (np.sign(early) == side) & (np.sign(late) == side)
        settled = np.abs(positions[0] - self._turned_at) >= TURNED
        weight = np.hanning(len(times) + 2)[1:-1]  # suppresses ripple with the position
        weight /= weight.sum()
        here, pull, when = weight @ positions, weight @ torques, float(weight @ times)
        return [
            Passage(when, int(j), here, float(pull[j]), float(velocity[j]), float(temperature[j]))
            for j in np.flatnonzero((side != 0) & onward & settled)
        ]


def _speed(t: Array, position: Array) -> Array:
    """Least-squares slope (n,) [rad/s]."""
    centred = t - t.mean()
    slope: Array = centred @ position / (centred @ centred)
    return slope
