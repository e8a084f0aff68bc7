"""Inverse dynamics along whole trajectories, by MuJoCo one row at a time."""

from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.cases.arms import Arm, mjcf


def compiled(arm: Arm) -> Any:
    """The arm's links and rotors as a MuJoCo model without friction, damping or limits."""
    import mujoco

    return quiet(mujoco.MjModel.from_xml_string(mjcf(arm)))


def quiet(model: Any) -> Any:
    """Disable everything in a model except the mechanics of its links and rotors."""
    import mujoco

    off = mujoco.mjtDisableBit
    model.opt.disableflags |= int(
        off.mjDSBL_CONSTRAINT
        | off.mjDSBL_CONTACT
        | off.mjDSBL_SENSOR
        | off.mjDSBL_ACTUATION
        | off.mjDSBL_DAMPER
        | off.mjDSBL_SPRING
    )
    return model


def inverse(model: Any, q: Array, v: Array, a: Array) -> Array:
    """Torques M(q) a + C(q, v) v + ∂V/∂q [N·m] along a trajectory, (K, n) each; rotors as in the model."""
    import mujoco

    data, out = mujoco.MjData(model), np.empty(q.shape)
    qpos, qvel, qacc, torque = data.qpos, data.qvel, data.qacc, data.qfrc_inverse
    for k in range(len(q)):
        qpos[:], qvel[:], qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = torque
    return out


def controlled_inertia(model: Any, q: Array) -> Array:
    """Inertia of each joint for a controller's gains [kg·m²], (n,): the largest over the poses `q` (K, n), but at most
    twice the least with the other joints free (1/(M⁻¹)_jj), for stability.
    """
    still, n = np.zeros_like(q), q.shape[1]
    weight = inverse(model, q, still, still)
    columns = [inverse(model, q, still, np.broadcast_to(push, q.shape)) - weight for push in np.eye(n)]
    mass = np.stack(columns, axis=2)
    free = 1.0 / np.diagonal(np.linalg.inv(mass), axis1=1, axis2=2)
    return np.asarray(np.minimum(np.diagonal(mass, axis1=1, axis2=2).max(0), 2.0 * free.min(0)))
