"""What an identification is given: positions, torques and loads, row by row."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask, as_array, frozen
from gcomp.errors import BadArray


@dataclass(frozen=True, eq=False)
class Readings:
    """K static readings of an arm of n joints. Raises BadArray on shapes, infinities, sigma ≤ 0."""

    position: Array
    """Raw position readings φ (K, n) [rad]."""
    torque: Array
    """Raw torque readings v (K, n) [N·m]; NaN where that joint's sensor does not count (pressed on a stop)."""
    sigma: Array
    """Standard deviation of a torque reading, (K, n) or (n,) [N·m]."""
    load: Array
    """Reference mass attached in that row (K,) [kg]; 0 where there is none."""

    def __post_init__(self) -> None:
        position = as_array("position", self.position, (None, None))
        count, n = position.shape
        torque = as_array("torque", self.torque, (count, n), finite=False)
        if np.isinf(torque).any():
            raise BadArray("torque has infinite readings; NaN is for a reading that does not count")
        sigma = np.array(np.broadcast_to(as_array("sigma", np.atleast_2d(self.sigma), (None, n)), (count, n)))
        if np.any(sigma <= 0):
            raise BadArray(f"sigma is {sigma.min()}, expected every standard deviation above zero [N·m]")
        load = as_array("load", self.load, (count,))
        frozen(self, position=position, torque=torque, sigma=sigma, load=load)

    @classmethod
    def of(cls, position: ArrayLike, torque: ArrayLike, sigma: ArrayLike, load: ArrayLike = 0.0) -> "Readings":
        """Readings from arrays; `sigma` may be one number or one a joint, `load` one number."""
        positions = as_array("position", position, (None, None))
        return cls(
            positions,
            np.asarray(torque, dtype=np.float64),
            np.broadcast_to(np.asarray(sigma, dtype=np.float64), positions.shape),
            np.broadcast_to(np.asarray(load, dtype=np.float64), positions.shape[:1]),
        )

    @property
    def counted(self) -> Mask:
        """Which torque readings count (K, n)."""
        return ~np.isnan(self.torque)

    def rows(self, which: Mask | slice) -> "Readings":
        """These rows alone."""
        return Readings(self.position[which], self.torque[which], self.sigma[which], self.load[which])

    def blocks(self, size: int = 2048) -> Iterator["Readings"]:
        """The same rows, at most `size` at a time: memory for what is computed from them stays bounded."""
        for begin in range(0, len(self.load), size):
            yield self.rows(slice(begin, begin + size))

    def joined(self, other: "Readings") -> "Readings":
        """These rows, then the other's."""
        pairs = zip(self._arrays(), other._arrays(), strict=True)
        return Readings(*(np.concatenate(pair) for pair in pairs))

    def _arrays(self) -> tuple[Array, Array, Array, Array]:
        return self.position, self.torque, self.sigma, self.load

    def require_arm(self, arm: Arm) -> None:
        """Raise BadArray unless these are readings of so many joints, with at least one that counts."""
        if self.position.shape[1] != arm.n:
            raise BadArray(f"readings of {self.position.shape[1]} joints, but the arm has {arm.n}")
        if not self.counted.any():
            raise BadArray("no torque reading counts: all are NaN")
