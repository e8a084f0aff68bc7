"""Fast gravity torque: one pose in plain floats, many poses in blocks of arrays that fit the cache.

Two passes along the arm: composite mass moments inwards, gravity outwards into each bar frame, and at each joint
τ_i = ḡ_ix N_iy − ḡ_iy N_ix, equation (E4) of docs/theory.md. The components across a joint's axis are one complex
number, so that turning about the axis by θ is a product with e^{iθ}.
"""

import threading
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array, as_batch, as_poses
from gcomp.gravity.single_pose import compile_single_pose, exact_cosine_and_sine

BLOCK = 5000
"""Poses per block: about two megabytes of work space for seven joints, best in benchmarks/bench_gravity.py. Not a power
of two: rows at the same offset of a memory page evict each other from the cache."""

ComplexArray = NDArray[np.complex128]


class GravityModel:
    """The gravity torque of one arm with one set of mass moments, prepared for many calls."""

    def __init__(self, arm: Arm, beta: ArrayLike) -> None:
        """Prepare for mass moments β (2n,) [kg·m]; raises BadArray on a wrong shape."""
        self.arm = arm
        self.beta = as_array("beta", beta, (2 * arm.n,), finite=False)
        self._moments = self.beta[::2] + 1j * self.beta[1::2]
        self._twists = [exact_cosine_and_sine(alpha) for alpha in arm.alpha]

    def __reduce__(self) -> "tuple[Callable[[Arm, Array], GravityModel], tuple[Arm, Array]]":
        """Pickled without the function of `one`, which is compiled again where it is unpickled."""
        return _ready, (self.arm, self.beta)

    @cached_property
    def one(self) -> Callable[[Array], Array]:
        """Holding torque (n,) [N·m] at one pose q (n,) [rad] in a few microseconds, as a function without checks."""
        return compile_single_pose(self.arm, self.beta)

    def many(self, q: ArrayLike) -> Array:
        """Holding torque (…, n) [N·m] at poses q (…, n) [rad]; raises BadArray if the last axis is not n."""
        poses, leading = as_poses("q", q, self.arm.n)
        torque = np.empty(poses.shape)
        for begin in range(0, len(poses), BLOCK):
            block = slice(begin, begin + BLOCK)
            space = _space_for(self.arm.n, len(poses[block]))
            _turn(self.arm, poses[block], space.tangent, space.double, space.turn)
            self._moments_inwards(space)
            self._gravity_outwards(space)
            np.copyto(torque[block], space.moment.imag.T)
        return as_batch(torque, leading)

    def _moments_inwards(self, space: "_TorqueBuffers") -> None:
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

    def _gravity_outwards(self, space: "_TorqueBuffers") -> None:
        """Gravity's conjugate ḡ_x − i ḡ_y into each bar frame; its product with N_i has τ_i as imaginary part."""
        gravity, (z, next_z) = space.gravity, space.along
        gravity.fill(complex(self.arm.gravity[0], -self.arm.gravity[1]))
        z.fill(self.arm.gravity[2])
        for i, (ca, sa) in enumerate(self._twists):
            np.multiply(space.turn[i], gravity, out=gravity)
            np.multiply(gravity, space.moment[i], out=space.moment[i])
            _turn_about_x(ca, sa, gravity.imag, z, gravity.imag, next_z, space.spare)
            z, next_z = next_z, z


def _ready(arm: Arm, beta: Array) -> GravityModel:
    """A model whose `one` is compiled already."""
    model = GravityModel(arm, beta)
    _ = model.one
    return model


class _TorqueBuffers:
    """Work space for `size` poses of n joints, one row a joint."""

    def __init__(self, n: int, size: int) -> None:
        self.tangent, self.double = np.empty((2, n, size))
        self.turn, self.moment = np.empty((2, n, size), dtype=np.complex128)
        self.gravity: ComplexArray = np.empty(size, dtype=np.complex128)
        self.along, self.spare = np.empty((2, size)), np.empty(size)


_kept = threading.local()


def _space_for(n: int, size: int) -> _TorqueBuffers:
    """Work space for a block, reused by each thread: new memory costs as much as the computation."""
    space: _TorqueBuffers | None = getattr(_kept, "space", None)
    if space is None or space.turn.shape != (n, size):
        space = _kept.space = _TorqueBuffers(n, size)
    return space


def half_angles(arm: Arm, q: Array, tangent: Array, double: Array) -> None:
    """At poses q (K, n) [rad]: t = tan(θ/2) into `tangent` (n, K), 2/(1 + t²) into `double` (n, K).

    numpy's tan is vectorised, its sin is not. Then cos θ = double − 1 and sin θ = tangent · double.
    """
    np.multiply(q.T, 0.5, out=tangent)
    if arm.theta_offset.any():
        np.add(tangent, 0.5 * arm.theta_offset[:, None], out=tangent)
    np.tan(tangent, out=tangent)
    np.multiply(tangent, tangent, out=double)
    np.add(double, 1.0, out=double)
    np.divide(2.0, double, out=double)


def _turn(arm: Arm, q: Array, tangent: Array, double: Array, turn: ComplexArray) -> None:
    """e^{iθ} (n, K) at poses q (K, n) [rad]."""
    half_angles(arm, q, tangent, double)
    np.multiply(tangent, double, out=turn.imag)
    np.subtract(double, 1.0, out=turn.real)


def _turn_about_x(ca: float, sa: float, y: Array, z: Array, to_y: Array, to_z: Array, spare: Array) -> None:
    """(to_y, to_z) = (ca y − sa z, sa y + ca z), to_y possibly y itself; a right angle takes two of six operations."""
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
