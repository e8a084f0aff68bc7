"""Mass moments and sensor offsets from any number of samples in bounded memory, by accumulated normal equations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.identifiability import NULL_RATIO, analyse, describe_null_space
from gcomp.identify.parameters import free_mask, parameter_names

BLOCK = 4096
"""Samples per block: a few megabytes of regressor for seven joints."""


@dataclass(frozen=True, eq=False)
class MomentFit:
    """Offsets and mass moments from samples of all joints' sensors; NaN if not identifiable."""

    offset: Array
    """(n,) [N·m]"""
    beta: Array
    """(2n,) [kg·m]"""
    names: tuple[str, ...]
    """Parameters of `covariance`: offsets, then mass moments."""
    covariance: Array
    """(3n, 3n); NaN rows and columns for parameters that are not identifiable."""
    null_space: tuple[str, ...]
    residual_rms: Array
    """Per joint (n,) [N·m]; NaN if no reading counted."""
    samples: int


class MomentAccumulator:
    """Weighted normal equations of τ_i = Y_i β + o_i, samples added block by block.

    For each joint the Gram matrix of its rows [Y_i, 1, τ_i] is kept: estimate, covariance and residual follow from it.
    """

    def __init__(self, arm: Arm, sigma: ArrayLike) -> None:
        """For torque readings with standard deviation sigma () or (n,) [N·m]."""
        self.arm, self.samples = arm, 0
        self.sigma = as_array("sigma", np.broadcast_to(sigma, (arm.n,)), (arm.n,))
        if np.any(self.sigma <= 0):
            raise BadArray(f"sigma is {self.sigma.min()}, expected above zero [N·m]")
        self._gram = np.zeros((arm.n, 2 * arm.n + 2, 2 * arm.n + 2))

    def add(self, position: ArrayLike, torque: ArrayLike) -> None:
        """Samples at positions (K, n) [rad] with torques (K, n) [N·m], gains applied; NaN torque does not count."""
        positions = as_array("position", position, (None, self.arm.n))
        torques = as_array("torque", torque, (len(positions), self.arm.n), finite=False)
        self.samples += len(positions)
        for begin in range(0, len(positions), BLOCK):
            self._add_block(positions[begin : begin + BLOCK], torques[begin : begin + BLOCK])

    def _add_block(self, positions: Array, torques: Array) -> None:
        regressor = gravity_regressor(self.arm, positions)
        counted = ~np.isnan(torques)
        rows = np.ones((2 * self.arm.n + 2, len(positions))).T  # column by column, as the regressor is
        for i in range(self.arm.n):
            felt = slice(2 * i, None)  # row i of Y is zero before column 2i
            rows[:, 2 * i : -2] = regressor[:, i, felt]
            rows[:, -1] = torques[:, i]
            kept = rows[:, felt] if counted[:, i].all() else rows[counted[:, i], felt]
            self._gram[i, felt, felt] += kept.T @ kept

    def solve(self) -> MomentFit:
        """Estimate, covariance for the given sigma, and residual of all samples; raises BadArray if there are none."""
        n, counts = self.arm.n, self._gram[:, -2, -2]
        if not counts.any():
            raise BadArray("no torque reading counts: none was added, or all readings are NaN")
        gram = self._gram / self.sigma[:, None, None] ** 2
        system, target = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
        system[n:, n:], target[n:] = gram[:, :-2, :-2].sum(axis=0), gram[:, :-2, -1].sum(axis=0)
        joints = np.arange(n)
        system[joints, joints], target[:n] = gram[:, -2, -2], gram[:, -2, -1]
        system[:n, n:] = gram[:, -2, :-2]
        system[n:, :n] = system[:n, n:].T
        unit = self._units(counts)
        spread, axes = np.linalg.eigh(system * np.outer(unit, unit))
        triangle = np.sqrt(np.maximum(spread, 0.0))[:, None] * axes.T / unit
        information = analyse(triangle, unit)
        keep = spread > NULL_RATIO**2 * spread[-1]
        found = unit * (axes[:, keep] @ ((axes[:, keep].T @ (target * unit)) / spread[keep]))
        estimate = np.where(information.determined, found, np.nan)
        names = tuple(
            name for name, free in zip(parameter_names(self.arm), free_mask(n, ("offset", "beta")), strict=True) if free
        )
        return MomentFit(
            offset=estimate[:n],
            beta=estimate[n:],
            names=names,
            covariance=information.covariance,
            null_space=describe_null_space(information.null_basis, names),
            residual_rms=self._residual(found, counts),
            samples=self.samples,
        )

    def _units(self, counts: Array) -> Array:
        """Natural units of offsets and mass moments: the RMS of the readings, and that over g."""
        size = float(np.sqrt((self._gram[:, -1, -1] / np.maximum(counts, 1)).max())) or 1.0
        moment = size / (float(np.linalg.norm(self.arm.gravity)) or 1.0)
        return np.concatenate([np.full(self.arm.n, size), np.full(2 * self.arm.n, moment)])

    def _residual(self, found: Array, counts: Array) -> Array:
        """Root mean square residual of each joint (n,): xᵀ G_i x with x = (β, o_i, −1)."""
        n = self.arm.n
        x = np.column_stack([np.tile(found[n:], (n, 1)), found[:n], -np.ones(n)])
        squares = np.maximum(np.einsum("ip,ipq,iq->i", x, self._gram, x), 0.0)
        return np.sqrt(np.where(counts > 0, squares / np.maximum(counts, 1), np.nan))
