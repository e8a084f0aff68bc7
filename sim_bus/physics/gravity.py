"""Statics of a compiled model: gravity torque and inertia at given poses."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array

Places = NDArray[np.intp] | slice


def gravity_torque(model: Any, dof: Places, q: Array) -> Array:
    """Holding torque ∂V/∂q of the joints at degrees of freedom `dof`, at the angles `q` (K, n) → (K, n) [N·m]."""
    scratch, q = mujoco.MjData(model), np.atleast_2d(np.asarray(q, float))
    torque = np.empty_like(q)
    for row, angles in enumerate(q):
        scratch.qpos[dof] = angles
        mujoco.mj_kinematics(model, scratch)
        mujoco.mj_comPos(model, scratch)
        mujoco.mj_rne(model, scratch, 0, scratch.qfrc_bias)
        torque[row] = scratch.qfrc_bias[dof]
    return torque


def inertia(model: Any, dof: Places, q: Array) -> Array:
    """Joint-space inertia matrix at the angles `q` (n,) → (n, n) [kg·m²]."""
    scratch, full = mujoco.MjData(model), np.empty((model.nv, model.nv))
    scratch.qpos[dof] = q
    mujoco.mj_forward(model, scratch)
    mujoco.mj_fullM(model, scratch, full)
    matrix: Array = full[dof][:, dof]
    return matrix


def tilt(angles: Array) -> Array:
    """Rotation of the base: about its x axis, then about its y axis [rad] → (3, 3)."""
    (cx, cy), (sx, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rotation: Array = about_x @ about_y
    return rotation
