"""Dry friction as MuJoCo's solver makes it: a joint creeps under less than its friction.

The solver's friction is soft: below a speed it is proportional to the speed, D·b·v, up to the friction loss, with
D = d/((1 − d)·w), where d is the impedance (first of `solimpfriction`), w the inverse inertia that the joint feels
(`dof_invweight0`) and b the damping of `solreffriction` (MuJoCo, "Computation", section on constraint parameters).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gcomp.arrays import Array

STIFFEST = 0.999
"""Impedance with which friction rests for all that matters."""
TIME_S = 0.01
"""Time constant of friction in models that are written [s]."""
IMPEDANCES = 0.0001, 0.9999
"""MuJoCo's own bounds of an impedance."""


def creep_speeds(model: Any, dofs: Sequence[int]) -> Array:
    """Speed below which each degree of freedom creeps under less than its friction loss [rad/s], (n,); 0 without."""
    rows = list(dofs)
    least = np.clip(model.dof_solimp[rows, 0], *IMPEDANCES)
    weight = np.maximum(model.dof_invweight0[rows], 1e-9)
    stiffness = least / (1.0 - least) / weight / creep_times(model, dofs)
    return np.asarray(model.dof_frictionloss[rows] / stiffness)


def creep_times(model: Any, dofs: Sequence[int]) -> Array:
    """Time in which a joint held by friction takes on its creeping speed [s], (n,): 1/b, as friction is D·(a + b·v)."""
    rows = list(dofs)
    most = np.clip(model.dof_solimp[rows, 1], *IMPEDANCES)
    first, second = model.dof_solref[rows, 0], model.dof_solref[rows, 1]
    time = np.maximum(first, 2.0 * float(model.opt.timestep))  # MuJoCo keeps it above two steps
    return np.asarray(most / np.where(first > 0.0, 2.0 / time, np.maximum(-second, 1e-9)))


def solver_parameters(friction: float, speed: float, inverse_inertia: float) -> tuple[list[float], list[float]]:
    """`solref` and `solimp` of a joint that creeps at `speed` [rad/s] under its dry `friction` [N·m]; at 0 it rests.

    `inverse_inertia` is the model's `dof_invweight0` [1/(kg·m²)].
    """
    damping = 2.0 / (TIME_S * IMPEDANCES[1])
    wanted = friction / (speed * damping) * inverse_inertia if speed > 0.0 else np.inf
    impedance = min(wanted / (1.0 + wanted), STIFFEST) if np.isfinite(wanted) else STIFFEST
    return [TIME_S, 1.0], [max(impedance, IMPEDANCES[0]), IMPEDANCES[1], 0.001, 0.5, 2.0]
