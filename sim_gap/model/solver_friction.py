"""Dry friction as MuJoCo's solver makes it: a joint creeps under less than its friction.

The solver's friction is soft: below a speed it is proportional to the speed, D·b·v, up to the friction loss, with
D = d/((1 − d)·w), where d is the impedance (first of `solimpfriction`), w the inverse inertia that the joint feels
(`dof_invweight0`) and b the damping of `solreffriction` (MuJoCo, "Computation", section on constraint parameters).
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from gcomp.arrays import Array

STIFFEST = 0.999
"""Impedance with which friction rests for all that matters."""
TIME_S = 0.01
"""Time constant of friction in models that are written [s]."""


def creep_speeds(model: Any, dofs: Sequence[int]) -> Array:
    """Speed below which each degree of freedom creeps under less than its friction loss [rad/s], (n,); 0 without."""
    rows = list(dofs)
    least, most = (np.clip(model.dof_solimp[rows, k], mujoco.mjMINIMP, mujoco.mjMAXIMP) for k in range(2))
    first, second = model.dof_solref[rows, 0], model.dof_solref[rows, 1]
    time = np.maximum(first, 2.0 * float(model.opt.timestep))  # MuJoCo keeps it above two steps
    damping = np.where(first > 0.0, 2.0 / time, np.maximum(-second, 1e-9))
    weight = np.maximum(model.dof_invweight0[rows], 1e-9)
    return np.asarray(model.dof_frictionloss[rows] / (least / (1.0 - least) / weight / (most / damping)))


def solver_parameters(friction: float, speed: float, inverse_inertia: float) -> tuple[list[float], list[float]]:
    """`solref` and `solimp` of a joint that creeps at `speed` [rad/s] under its dry `friction` [N·m]; at 0 it rests.

    `inverse_inertia` is the model's `dof_invweight0` [1/(kg·m²)].
    """
    damping = 2.0 / (TIME_S * mujoco.mjMAXIMP)
    wanted = friction / (speed * damping) * inverse_inertia if speed > 0.0 else np.inf
    impedance = min(wanted / (1.0 + wanted), STIFFEST) if np.isfinite(wanted) else STIFFEST
    return [TIME_S, 1.0], [max(impedance, mujoco.mjMINIMP), mujoco.mjMAXIMP, 0.001, 0.5, 2.0]
