"""Readings at rest or in slow motion, the input of every identification: one row a reading, one column a joint."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array, frozen
from gcomp.errors import BadArray


def _zero() -> Any:
    """0 for every reading; `__post_init__` gives it its shape."""
    return np.zeros(())


@dataclass(frozen=True, eq=False)
class StaticReadings:
    """K readings at rest or in slow motion. Raises BadArray on wrong shapes, infinite readings and sigma ≤ 0."""

    position: Array
    """Raw position readings φ (K, n) [rad]."""
    torque: Array
    """Raw torque readings v (K, n) [N·m]; NaN if that joint's sensor does not count (pressed on a stop)."""
    sigma: Array
    """Standard deviation of a torque reading, (K, n) or (n,) [N·m]."""
    load: Array = field(default_factory=_zero)
    """Reference mass attached (K,) [kg]; 0 for none."""
    direction: Array = field(default_factory=_zero)
    """Sign of each joint's last motion (K, n); 0 if it has not moved or that is not known."""
    series: NDArray[np.int64] = field(default_factory=_zero)
    """Number of the sweep or recording that a reading belongs to (K,)."""
    velocity: Array = field(default_factory=_zero)
    """Of each joint (K, n) [rad/s]; 0 at rest."""
    warmth: Array = field(default_factory=_zero)
    """How much warmer each drive was than at a reference (K, n) [K], or the share of the time since then if no
    temperature is known."""

    def __post_init__(self) -> None:
        position = as_array("position", self.position, (None, None))
        count, n = position.shape
        torque = as_array("torque", self.torque, (count, n), finite=False)
        if np.isinf(torque).any():
            raise BadArray("torque has infinite readings: write NaN for a reading that is to be ignored")
        sigma = np.array(np.broadcast_to(as_array("sigma", np.atleast_2d(self.sigma), (None, n)), (count, n)))
        if np.any(sigma <= 0):
            raise BadArray(f"sigma is {sigma.min()}, expected every standard deviation above zero [N·m]")
        load = as_array("load", _spread(self.load, (count,)), (count,))
        direction = as_array("direction", _spread(self.direction, (count, n)), (count, n))
        series = np.asarray(as_array("series", _spread(self.series, (count,)), (count,)), dtype=np.int64)
        velocity = as_array("velocity", _spread(self.velocity, (count, n)), (count, n))
        warmth = as_array("warmth", _spread(self.warmth, (count, n)), (count, n))
        frozen(self, position=position, torque=torque, sigma=sigma, load=load, direction=direction, series=series)
        frozen(self, velocity=velocity, warmth=warmth)

    @classmethod
    def of(cls, position: ArrayLike, torque: ArrayLike, sigma: ArrayLike, load: ArrayLike = 0.0) -> "StaticReadings":
        """From arrays; `sigma` may be one number or one per joint, `load` one number."""
        positions = as_array("position", position, (None, None))
        return cls(
            positions,
            np.asarray(torque, dtype=np.float64),
            np.broadcast_to(np.asarray(sigma, dtype=np.float64), positions.shape),
            np.asarray(load, dtype=np.float64),
        )

    @property
    def counted(self) -> Mask:
        """Torque readings that count (K, n)."""
        return ~np.isnan(self.torque)

    def table(self, values: Array) -> Array:
        """Values of the torque readings that count (R,) as (K, n); NaN elsewhere."""
        whole = np.full(self.torque.shape, np.nan)
        whole[self.counted] = values
        return whole

    def __len__(self) -> int:
        return len(self.position)

    def rows(self, which: Mask | slice) -> "StaticReadings":
        return StaticReadings(*(column[which] for column in self._columns()))

    def blocks(self, size: int = 2048) -> Iterator["StaticReadings"]:
        """The same readings, at most `size` at a time, so that the memory for what is computed from them is bounded."""
        for begin in range(0, len(self), size):
            yield self.rows(slice(begin, begin + size))

    def joined(self, *others: "StaticReadings") -> "StaticReadings":
        """These readings, then the others'."""
        columns = zip(*(each._columns() for each in (self, *others)), strict=True)
        return StaticReadings(*(np.concatenate(column) for column in columns))

    def _columns(self) -> list[Any]:
        return [getattr(self, field.name) for field in fields(self)]

    def require_arm(self, arm: Arm) -> None:
        """Raise BadArray unless these are readings of the arm's n joints, and at least one counts."""
        if self.position.shape[1] != arm.n:
            raise BadArray(f"the readings have {self.position.shape[1]} joints, but the arm has {arm.n}")
        if not self.counted.any():
            raise BadArray("no torque reading can be used: all are NaN")


def _spread(value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    """One number as an array of that shape; an array as it is."""
    return np.broadcast_to(value, shape) if np.ndim(value) == 0 else value
