"""Covariance of an arm's discrepancy, the torque that its gravity model lacks, between two poses (docs/theory.md)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_regressor, gravity_torque

LOCAL_ANGLE = 0.5
"""Correlation length in a joint's own angle and in its neighbours' [rad]: cables, encoder eccentricity and gear errors
have one to four periods a turn."""
WIDE_ANGLE = 1.4
"""Correlation length in all angles at once [rad]: wrong kinematics and sag are products of first harmonics."""
PARTS = ("local", "wide", "torque")
"""Parts whose sizes are learned: by a joint's own and its neighbours' angles, by all angles, and by torque, of the
joint itself (a sensor that is not linear) and of the others (crosstalk)."""
CONSTANT, SLOPE, SIDE = 0.1, 0.1, 0.05
"""Shares in the variance of each part: of an offset and a gain, which a calibration gets wrong by this much where there
is discrepancy, and of the side of approach (hysteresis)."""
WARM = 20.0
"""Rise of temperature over which a zero moves by the size that is expected of it [K]: a joint that has warmed up."""


@dataclass(frozen=True)
class Points:
    """K poses as the kernel sees them."""

    position: Array
    """True angles (K, n) [rad]."""
    torque: Array
    """Gravity torque over its typical size (K, n)."""
    side: Array
    """Sign of each joint's last motion (K, n); 0 if unknown."""
    warmth: Array
    """Temperature above that of the reference (K, n), in units of WARM; 0 if it is not known."""

    @cached_property
    def turned(self) -> Array:
        """Cosine and sine of each joint's angle (n, K, 2)."""
        return np.stack([np.cos(self.position.T), np.sin(self.position.T)], axis=2)


class Kernel:
    """Unit covariance of each joint's discrepancy; its variance is about 1 at a typical pose."""

    def __init__(self, arm: Arm, beta: Array) -> None:
        """beta (2n,) [kg·m] is the gravity model."""
        self._arm, self._beta = arm, beta
        lower, upper = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
        self.poses: Array = np.random.default_rng(0).uniform(lower, upper, (256, arm.n))
        """Random poses over the joint ranges [rad]."""
        typical = gravity_torque(arm, beta, self.poses).std(axis=0)
        self.typical: Array = np.maximum(typical, 1e-3 * max(float(typical.max()), 1e-9))
        """Standard deviation of each joint's gravity torque over the joint ranges (n,) [N·m]; never 0."""

    @cached_property
    def payload_rank(self) -> int:
        """How many of a payload's mass and first moments the arm's levers show, over its whole range."""
        at_origin, by_point = payload_columns(self._arm)
        columns = gravity_regressor(self._arm, self.poses) @ np.column_stack([at_origin, by_point])
        flat = columns.reshape(-1, columns.shape[2])
        size = np.linalg.norm(flat, axis=0)
        return int(np.linalg.matrix_rank(flat / np.where(size > 1e-9, size, 1.0), tol=1e-6))

    def points(self, position: Array, side: Array, warmer: Array | None = None, torque: Array | None = None) -> Points:
        """Poses (K, n) [rad], sides of approach, temperatures above the reference's (K, n) [K] and gravity torques
        (K, n) [N·m], computed if not given."""
        warmth = np.zeros_like(position) if warmer is None else warmer / WARM
        torque = gravity_torque(self._arm, self._beta, position) if torque is None else torque
        return Points(position, torque / self.typical, side, warmth)

    def between(self, a: Points, b: Points) -> Array:
        """Covariance (parts, n, A, B) between two sets of poses, joint by joint, of each part at size 1."""
        parts, common = self._shapes(a, b)
        covariance: Array = (1.0 - CONSTANT - SLOPE - SIDE) * np.stack(parts) + common
        return covariance

    def weighted(self, smooth: Array, a: Points, b: Points) -> Array:
        """Covariance (n, A, B) between two sets of poses from the sizes of the parts (parts, n) [N·m]."""
        parts, common = self._shapes(a, b)
        square = (smooth**2)[:, :, None, None]
        covariance: Array = square.sum(axis=0) * common
        for size, part in zip((1.0 - CONSTANT - SLOPE - SIDE) * square, parts, strict=True):
            covariance += size * part
        return covariance

    def _shapes(self, a: Points, b: Points) -> tuple[tuple[Array, ...], Array]:
        """(The shape of each part, (n, A, B) each; what all parts have in common, (n, A, B))."""
        n = a.position.shape[1]
        away = 1.0 - a.turned @ b.turned.swapaxes(1, 2)
        near = np.exp(away * (-1 / LOCAL_ANGLE**2))
        beside = np.zeros_like(near)
        beside[:-1] += near[1:]
        beside[1:] += near[:-1]
        neighbours = np.array([(j > 0) + (j < n - 1) for j in range(n)])
        local = near * (1.0 + beside) / (1.0 + neighbours)[:, None, None]
        wide = np.exp(-away.sum(axis=0) / WIDE_ANGLE**2)
        slope = a.torque.T[:, :, None] * b.torque.T[:, None, :]
        crosstalk = (slope.sum(axis=0) - slope) / max(n - 1, 1)
        curve = slope * slope * (1 / 6.0 + slope / 30.0)  # E t⁴ = 3, E t⁶ = 15 of a normal t: each half of the part
        side = a.side.T[:, :, None] * b.side.T[:, None, :]
        common = CONSTANT + SLOPE * slope + SIDE * side
        return (local, np.broadcast_to(wide, local.shape), (crosstalk + curve) / 2), common
