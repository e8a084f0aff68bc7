"""Cables that are dressed along the arm: a spring that lags, bent by a joint and by the next one.

Cable i bends by φ = θ_i − rest + share·θ_j, with angles from mid-range and the next joint j (the one before at the
tip). It pulls on both joints with −(stiffness·φ + pull·(φ − p)/lag)·∂φ/∂θ, where p follows φ as a play of half width
`lag`: what a Prandtl element does, an elastic part that slips.
"""

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections


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
