"""How much a joint has to turn: the inertia about its axis of everything beyond it, the other joints standing."""

import numpy as np

from gcomp.arm.load import PlacedChain
from gcomp.arrays import Array


def joint_inertias(placed: PlacedChain, poses: Array, mass: float = 0.0) -> Array:
    """Inertia about each joint's axis [kg·m²] (K, n) at joint angles `poses` (K, n) [rad].

    Rotors are as the model has them; `mass` [kg] is a point on the origin of the last joint.
    """
    import mujoco

    model, data = placed.model, placed.data
    chain = [model.joint(name).id for name in placed.arm.arm.names]
    places, rates = model.jnt_qposadr[chain], model.jnt_dofadr[chain]
    column, found = np.zeros(model.nv), np.empty(poses.shape)
    before = data.qpos.copy()
    for row, pose in enumerate(poses):
        data.qpos[places] = pose
        mujoco.mj_fwdPosition(model, data)
        levers = np.cross(data.xanchor[chain[-1]] - data.xanchor[chain], data.xaxis[chain])
        for joint, rate in enumerate(rates):
            mujoco.mj_mulM(model, data, column, np.eye(model.nv)[rate])
            found[row, joint] = column[rate] + mass * (levers[joint] ** 2).sum()
    data.qpos[:] = before
    mujoco.mj_fwdPosition(model, data)
    return found
