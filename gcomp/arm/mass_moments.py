"""Mass moments of an arm, from its links' inertials and of a payload (docs/theory.md, equations (R) and (P))."""

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array

VERTICAL = 1e-4
"""Angle between a joint's axis and gravity below which it counts as vertical [rad]: models round π to 3.1416."""


def base_parameters(arm: Arm, mass: ArrayLike, first_moment: ArrayLike) -> Array:
    """Mass moments β = (n_1x, n_1y, …, n_nx, n_ny) (2n,) [kg·m], on which gravity torque depends; equation (R).

    mass (n,) [kg]; first_moment (n, 3) [kg·m], mass times centre of mass in each link's bar frame (origin
    o_{i-1} on the joint axis, turning with the joint, z along the axis).
    """
    masses = as_array("mass", mass, (arm.n,))
    moments = as_array("first_moment", first_moment, (arm.n, 3))
    span, beta = arm.span, np.empty((arm.n, 2))
    distal_mass = along_axis = 0.0
    for i in reversed(range(arm.n)):
        next_axis = np.array([0.0, -np.sin(arm.alpha[i]), np.cos(arm.alpha[i])])
        moment = moments[i] + distal_mass * span[i] + along_axis * next_axis
        beta[i], along_axis = moment[:2], float(moment[2])
        distal_mass += float(masses[i])
    return beta.ravel()


def link_columns(arm: Arm, link: int) -> tuple[Array, Array]:
    """(E_0 (2n,), E_ρ (2n, 3)): mass μ at point ρ of a link's bar frame adds Δβ = μ (E_0 + E_ρ ρ); equation (P)."""
    mass, none = np.zeros(arm.n), np.zeros((arm.n, 3))
    mass[link] = 1.0
    by_point = np.empty((2 * arm.n, 3))
    for axis in range(3):
        moment = none.copy()
        moment[link, axis] = 1.0
        by_point[:, axis] = base_parameters(arm, np.zeros(arm.n), moment)
    return base_parameters(arm, mass, none), by_point


def payload_columns(arm: Arm) -> tuple[Array, Array]:
    """The same of the last link, which carries payloads."""
    return link_columns(arm, arm.n - 1)


def base_parameter_names(arm: Arm) -> tuple[str, ...]:
    """Names of the 2(n − p) mass moments that act on a torque in some pose (docs/theory.md, section 2.4).

    p leading joints have their axis along gravity in every pose, to within `VERTICAL`; they carry no torque.
    """
    vertical, tolerance = 0, VERTICAL
    strength = float(np.linalg.norm(arm.gravity))
    if np.hypot(arm.gravity[0], arm.gravity[1]) <= tolerance * strength:
        bends = np.abs(np.sin(arm.alpha)) > tolerance
        vertical = int(np.argmax(bends)) + 1 if bends[:-1].any() else arm.n
    return tuple(f"mass_moment_{axis}[{name}]" for name in arm.names[vertical:] for axis in "xy")
