"""The gravity regressor at many poses at once: each lever w_i = z_{i-1} × g followed outwards along the arm.

A row of the arrays is a joint's lever, a column a component in a bar frame, each contiguous over the poses. A twist by
a multiple of 90° costs nothing: it swaps components and changes their signs, which the next turn takes into account.
"""

from typing import NamedTuple

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.batch import half_angles
from gcomp.gravity.single_pose import exact_cosine_and_sine

BLOCK = 10_000
"""Poses per block: about four megabytes of work space for seven joints, best in benchmarks/bench_gravity.py."""


class Signed(NamedTuple):
    """One component of vectors, (K,) or (n, K), up to its sign, 1 or −1."""

    array: Array
    sign: float

    def rows(self, first: int, last: int) -> "Signed":
        return Signed(self.array[first:last], self.sign)


def regressor(arm: Arm, q: Array) -> Array:
    """Regressor Y (K, n, 2n) [m/s²] at poses q (K, n) [rad], equation (Y), each column Y[:, i, c] contiguous."""
    n, (size, _) = arm.n, q.shape
    columns = np.empty((2 * n, n, size))  # np.zeros allocates small pages: half a millisecond more
    columns[:, 0] = 0.0
    for j in range(n - 1):
        columns[2 * j : 2 * j + 2, j + 1 :] = 0.0
    space = _RegressorBuffers(n, min(size, BLOCK))
    for begin in range(0, size, BLOCK):
        poses = q[begin : begin + BLOCK]
        if len(poses) < space.size:
            space = _RegressorBuffers(n, len(poses))
        space.turn_by(arm, poses)
        _levers_outwards(arm, columns[..., begin : begin + BLOCK], space)
    return columns.transpose(2, 1, 0)


def _levers_outwards(arm: Arm, columns: Array, space: "_RegressorBuffers") -> None:
    """Levers w_i in bar frame j into columns[2j : 2j + 2, i], i ≤ j; gravity is turned along and gives w_j.

    Rows from j + 1 on are zero, so that a new lever has no component along its axis.
    """
    first = int(not arm.gravity[:2].any())  # a first joint along gravity has no lever
    gx, gy, gz = (np.full(space.size, component) for component in arm.gravity)
    y, z, g_y, g_z = Signed(space.y, 1.0), Signed(space.z, 1.0), Signed(gy, 1.0), Signed(gz, 1.0)
    x = space.y
    for j, alpha in enumerate(arm.alpha):
        into_x, into_y = columns[2 * j : 2 * j + 2]
        if j > first:
            space.turn(j, x[first:j], y.rows(first, j), into_x[first:j], into_y[first:j])
        if j >= first:
            space.turn(j, gx, g_y, into_y[j], into_x[j])
            np.negative(into_x[j], out=into_x[j])  # w_j = (−g_y, g_x, 0)
        if j + 1 == arm.n:
            return
        twist = exact_cosine_and_sine(alpha)
        x, gx = into_x, into_y[j]
        g_y, g_z = _about_x(twist, Signed(into_x[j], -1.0), g_z, (space.g_y, space.g_z, space.spare[j]))
        y, z = _about_x(twist, Signed(into_y, 1.0), z, (space.y, space.z, space.spare))


def _about_x(
    twist: tuple[float, float], y: Signed, z: Signed, space: tuple[Array, Array, Array]
) -> tuple[Signed, Signed]:
    """(y cos α + z sin α, z cos α − y sin α): no arithmetic if α is a multiple of 90°."""
    ca, sa = twist
    if sa == 0.0:
        return Signed(y.array, ca * y.sign), Signed(z.array, ca * z.sign)
    if ca == 0.0:
        return Signed(z.array, sa * z.sign), Signed(y.array, -sa * y.sign)
    to_y, to_z, spare = space
    np.multiply(y.array, ca * y.sign, out=to_y)
    np.multiply(z.array, sa * z.sign, out=spare)
    np.add(to_y, spare, out=to_y)
    np.multiply(z.array, ca * z.sign, out=to_z)
    np.multiply(y.array, sa * y.sign, out=spare)
    np.subtract(to_z, spare, out=to_z)
    return Signed(to_y, 1.0), Signed(to_z, 1.0)


class _RegressorBuffers:
    """Work space for `size` poses of n joints, and the turns about each joint's axis."""

    def __init__(self, n: int, size: int) -> None:
        self.size = size
        self.cos, self.minus_cos, self.sin, self.tangent, self.spare = np.empty((5, n, size))
        self.y, self.z = np.zeros((2, n, size))
        self.g_y, self.g_z = np.zeros((2, size))

    def turn_by(self, arm: Arm, q: Array) -> None:
        """Compute the turns at poses q (K, n) [rad]."""
        cos = self.cos
        half_angles(arm, q, self.tangent, cos)
        np.multiply(self.tangent, cos, out=self.sin)
        np.subtract(1.0, cos, out=self.minus_cos)
        np.subtract(cos, 1.0, out=cos)

    def turn(self, j: int, x: Array, y: Signed, into_x: Array, into_y: Array) -> None:
        """Into the frame turned by θ_j: (x cos θ + y sin θ, y cos θ − x sin θ)."""
        product = self.spare[: len(x)] if x.ndim > 1 else self.spare[0]
        np.multiply(self.cos[j], x, out=product)
        np.multiply(self.sin[j], y.array, out=into_x)
        (np.add if y.sign > 0.0 else np.subtract)(product, into_x, out=into_x)
        np.multiply(self.cos[j] if y.sign > 0.0 else self.minus_cos[j], y.array, out=into_y)
        np.multiply(self.sin[j], x, out=product)
        np.subtract(into_y, product, out=into_y)
