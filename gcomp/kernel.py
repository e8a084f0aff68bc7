"""Gravity torque computed fast: one pose in plain floats, many poses in blocks of arrays that stay in the cache.

Two passes along the arm: composite mass moments inwards, gravity outwards into each bar frame, and at each joint
τ_i = ḡ_ix N_iy − ḡ_iy N_ix, equation (E4) of the theory note. The components across a joint's axis are one complex
number, so that turning about the axis by θ is a product with e^{iθ}.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gcomp.arm import Arm
from gcomp.arrays import Array, as_array, as_batch, as_poses
from gcomp.unrolled import compile_single_pose, without_rounding

BLOCK = 2048
"""Poses worked on at a time: about half a megabyte of work space for seven joints."""

REGRESSOR_BLOCK = 1024
"""The same for the regressor, which is larger."""

ComplexArray = NDArray[np.complex128]


class GravityModel:
    """The gravity torque of one arm with one set of mass moments, prepared for many calls.

    Not for several threads at once: calls share their work space.
    """

    def __init__(self, arm: Arm, beta: ArrayLike) -> None:
        """Prepare for mass moments β (2n,) [kg·m]; raises BadArray on a wrong shape."""
        self.arm = arm
        self.beta = as_array("beta", beta, (2 * arm.n,), finite=False)
        self._moments = self.beta[::2] + 1j * self.beta[1::2]
        self._twists = [without_rounding(alpha) for alpha in arm.alpha]
        self._space: _Space | None = None

    @cached_property
    def one(self) -> Callable[[Array], Array]:
        """Holding torque (n,) [N·m] at one pose q (n,) [rad], in a few microseconds: its argument is not checked."""
        return compile_single_pose(self.arm, self.beta)

    def many(self, q: ArrayLike) -> Array:
        """Holding torque (…, n) [N·m] at poses q (…, n) [rad]; raises BadArray where the last axis is not n."""
        poses, leading = as_poses("q", q, self.arm.n)
        torque = np.empty(poses.shape)
        for begin in range(0, len(poses), BLOCK):
            block = slice(begin, begin + BLOCK)
            space = self._space_for(len(poses[block]))
            _turn(self.arm, poses[block], 1.0, space.tangent, space.square, space.turn)
            self._moments_inwards(space)
            self._gravity_outwards(space)
            np.copyto(torque[block], space.moment.imag.T)
        return as_batch(torque, leading)

    def _space_for(self, size: int) -> "_Space":
        """Work space for a block, kept for the next one of that size."""
        if self._space is None or self._space.size != size:
            self._space = _Space(self.arm.n, size)
        return self._space

    def _moments_inwards(self, space: "_Space") -> None:
        """Composite mass moments N_i = n_i + Rx(α_i) Rz(θ_{i+1}) N_{i+1} into space.moment."""
        z, next_z = space.along
        last = self.arm.n - 1
        space.moment[last].fill(self._moments[last])
        z.fill(0.0)
        for i in range(last, 0, -1):
            moment = np.multiply(space.turn[i], space.moment[i], out=space.moment[i - 1])
            _turn_about_x(*self._twists[i - 1], moment.imag, z, moment.imag, next_z, space.spare)
            np.add(moment, self._moments[i - 1], out=moment)
            z, next_z = next_z, z

    def _gravity_outwards(self, space: "_Space") -> None:
        """Gravity's conjugate ḡ_x − i ḡ_y into each bar frame; its product with N_i has τ_i as imaginary part."""
        gravity, (z, next_z) = space.gravity, space.along
        gravity.fill(complex(self.arm.gravity[0], -self.arm.gravity[1]))
        z.fill(self.arm.gravity[2])
        for i, (ca, sa) in enumerate(self._twists):
            np.multiply(space.turn[i], gravity, out=gravity)
            np.multiply(gravity, space.moment[i], out=space.moment[i])
            _turn_about_x(ca, sa, gravity.imag, z, gravity.imag, next_z, space.spare)
            z, next_z = next_z, z


def regressor(arm: Arm, q: Array) -> Array:
    """Regressor Y (K, n, 2n) [m/s²] at poses q (K, n) [rad], equation (Y): each w_i = z_{i-1} × g, frame by frame."""
    n, (size, _) = arm.n, q.shape
    regressor = np.empty((size, n, n), dtype=np.complex128)
    twists = [without_rounding(alpha) for alpha in arm.alpha]
    rows = np.zeros((n, n, min(size, REGRESSOR_BLOCK)), dtype=np.complex128)
    scratch = np.empty((3, n + 1, rows.shape[2]))
    turn, stack = np.empty((2, n + 1, rows.shape[2]), dtype=np.complex128)
    for begin in range(0, size, REGRESSOR_BLOCK):
        block = regressor[begin : begin + REGRESSOR_BLOCK]
        count = len(block)
        if count < rows.shape[2]:
            rows, scratch, turn, stack = (space[..., :count].copy() for space in (rows, scratch, turn, stack))
        _turn(arm, q[begin : begin + count], -1.0, scratch[0, :n], scratch[1, :n], turn[:n])
        _levers_outwards(arm, twists, turn, rows, stack, scratch)
        np.copyto(block.reshape(count, n * n), rows.reshape(n * n, count).T)
    return regressor.view(np.float64)


def _levers_outwards(
    arm: Arm,
    twists: list[tuple[float, float]],
    turn: ComplexArray,
    rows: ComplexArray,
    stack: ComplexArray,
    scratch: Array,
) -> None:
    """w_i in bar frame j into rows[i, j], i ≤ j; gravity itself goes along in the stack until it becomes w_j."""
    z, next_z, spare = scratch
    stack[0].fill(complex(arm.gravity[0], arm.gravity[1]))
    z[0].fill(arm.gravity[2])
    for j, (ca, sa) in enumerate(twists):
        frame, gravity = rows[: j + 1, j], stack[j + 1]
        np.multiply(turn[j], stack[: j + 1], out=frame)
        np.copyto(gravity, frame[j])
        np.multiply(gravity, 1j, out=frame[j])
        np.copyto(z[j + 1], z[j])
        z[j].fill(0.0)
        if j + 1 < arm.n:
            np.copyto(stack[: j + 1].real, frame.real)
            _turn_about_x(ca, -sa, frame.imag, z[: j + 1], stack[: j + 1].imag, next_z[: j + 1], spare[: j + 1])
            _turn_about_x(ca, -sa, gravity.imag, z[j + 1], gravity.imag, next_z[j + 1], spare[j + 1])
            z, next_z = next_z, z


class _Space:
    """Work space for `size` poses of n joints, one row a joint."""

    def __init__(self, n: int, size: int) -> None:
        self.size = size
        self.tangent, self.square = np.empty((2, n, size))
        self.turn, self.moment = np.empty((2, n, size), dtype=np.complex128)
        self.gravity: ComplexArray = np.empty(size, dtype=np.complex128)
        self.along, self.spare = np.empty((2, size)), np.empty(size)


def _turn(arm: Arm, q: Array, sign: float, tangent: Array, square: Array, turn: ComplexArray) -> None:
    """e^{± iθ} (n, K) from t = tan(± θ/2): numpy's tan is vectorised where its sin and cos are not."""
    np.multiply(q.T, 0.5 * sign, out=tangent)
    if arm.theta_offset.any():
        np.add(tangent, arm.theta_offset[:, None] * (0.5 * sign), out=tangent)
    np.tan(tangent, out=tangent)
    np.multiply(tangent, tangent, out=square)
    np.add(square, 1.0, out=square)
    np.divide(2.0, square, out=square)
    np.multiply(tangent, square, out=turn.imag)
    np.subtract(square, 1.0, out=turn.real)


def _turn_about_x(ca: float, sa: float, y: Array, z: Array, to_y: Array, to_z: Array, spare: Array) -> None:
    """(to_y, to_z) = (ca y − sa z, sa y + ca z), to_y possibly y itself; right angles take two operations of six."""
    if ca == 0.0:
        np.multiply(y, sa, out=to_z)
        np.multiply(z, -sa, out=to_y)
        return
    np.multiply(z, ca, out=to_z)
    np.multiply(y, sa, out=spare)
    np.add(to_z, spare, out=to_z)
    np.multiply(z, sa, out=spare)
    np.multiply(y, ca, out=to_y)
    np.subtract(to_y, spare, out=to_y)
