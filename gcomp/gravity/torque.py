"""Gravity torque of an arm at many poses at once, its regressor and its stiffness (docs/theory.md, sections 1 and 2).

Torque is the holding torque τ = ∂V/∂q [N·m], which a joint at rest transmits.
"""

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm, bar_frames
from gcomp.arrays import Array, as_array, as_batch, as_poses, cross
from gcomp.gravity.batch import GravityModel
from gcomp.gravity.regressor import regressor


def gravity_torque(arm: Arm, beta: ArrayLike, q: ArrayLike) -> Array:
    """Holding torque τ (…, n) [N·m] at poses q (…, n) [rad] for mass moments β (2n,) [kg·m]; equation (E4).

    For many calls with the same mass moments, prepare a GravityModel.
    """
    return GravityModel(arm, beta).many(q)


def gravity_regressor(arm: Arm, q: ArrayLike) -> Array:
    """Regressor Y (…, n, 2n) [m/s²] at poses q (…, n) [rad], with τ = Y β; equation (Y).

    The memory layout is column by column, as in LAPACK: Y[:, i, c] is contiguous, Y[k] is not.
    """
    poses, leading = as_poses("q", q, arm.n)
    return as_batch(regressor(arm, poses), leading)


def gravity_stiffness(arm: Arm, beta: ArrayLike, q: ArrayLike) -> Array:
    """Stiffness H = ∂τ/∂q (…, n, n) [N·m/rad], symmetric, at poses q (…, n) [rad] for β (2n,); equation (H)."""
    poses, leading = as_poses("q", q, arm.n)
    moments = as_array("beta", beta, (2 * arm.n,), finite=False).reshape(arm.n, 2)
    frames = bar_frames(arm, poses)
    turned = cross(frames.rotation[..., 2], composite_moments(frames.rotation, moments))
    lower = np.einsum("kid,kld->kil", turned, frames.lever)
    stiffness = np.tril(lower) + np.swapaxes(np.tril(lower, -1), -1, -2)
    return as_batch(stiffness, leading)


def composite_moments(rotation: Array, moments: Array) -> Array:
    """S_i = Σ_{j≥i} B_j n̄_j (K, n, 3) [kg·m] in the base frame; moments (n, 2) or (K, n, 2)."""
    each = rotation[..., 0] * moments[..., 0, None] + rotation[..., 1] * moments[..., 1, None]
    composite: Array = np.cumsum(each[:, ::-1], axis=1)[:, ::-1]
    return composite


def gravity_levers(arm: Arm, q: ArrayLike) -> Array:
    """Levers of gravity Γ_i = |z_{i-1} × g| (…, n) [m/s²] at poses q (…, n) [rad]."""
    poses, leading = as_poses("q", q, arm.n)
    return as_batch(np.linalg.norm(bar_frames(arm, poses).lever, axis=-1), leading)


def torque_covariance(arm: Arm, covariance: ArrayLike, q: ArrayLike) -> Array:
    """Covariance of τ (…, n, n) [N²·m²] at poses q (…, n) from that of β (2n, 2n): Y Cov(β) Yᵀ."""
    of_beta = as_array("covariance", covariance, (2 * arm.n, 2 * arm.n), finite=False)
    regressor = gravity_regressor(arm, q)
    covariance_of_torque: Array = regressor @ of_beta @ np.swapaxes(regressor, -1, -2)
    return covariance_of_torque
