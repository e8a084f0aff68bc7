"""Bounds that a command carries along, checked in every cycle: whoever sent it may be busy when they are crossed."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from armlink.arrays import Array
from armlink.errors import Refused


@dataclass(frozen=True, eq=False)
class ReadingBounds:
    """Bounds of n joints; infinite for a joint that has none."""

    lower: Array
    """Least position reading (n,) [rad]."""
    upper: Array
    """Greatest position reading (n,) [rad]."""
    lag: Array
    """Greatest distance between position target and reading (n,) [rad]."""

    @classmethod
    def none(cls, n: int) -> "ReadingBounds":
        return cls(np.full(n, -np.inf), np.full(n, np.inf), np.full(n, np.inf))

    def check(self, names: tuple[str, ...], position: Array, target: Array) -> None:
        """Raise Crossed for the joint that is furthest beyond a bound; NaN is beyond none."""
        beyond = np.fmax(self.lower - position, position - self.upper)
        if np.count_nonzero(beyond > 0):
            joint = int(np.argmax(beyond > 0))
            raise Crossed(names[joint], joint, "range", float(position[joint]), float(target[joint]))
        lag = np.abs(target - position) - self.lag
        if np.count_nonzero(lag > 0):
            joint = int(np.nanargmax(lag))
            raise Crossed(names[joint], joint, "lag", float(position[joint]), float(target[joint]))


class Crossed(Refused):
    """A joint crossed a bound of the command's guard; the joints hold."""

    def __init__(self, name: str, joint: int, bound: str, position: float, target: float) -> None:
        """Joint's name and index; `range` or `lag`; where it is and where it should be [rad]."""
        what = f"the joint does not follow its target {target:.3f} rad"
        if bound == "range":
            what = "the joint left the range that the command allows"
        super().__init__(f"{name}: at {position:.3f} rad {what}")
        self.name, self.joint, self.bound, self.position, self.target = name, joint, bound, position, target
        self.sample: Any = None
        """The Sample that showed it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.joint, self.bound, self.position, self.target), {"sample": self.sample}
