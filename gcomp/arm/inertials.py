"""Inertials of a model's bodies: ten parameters about a point, the bodies that can exist, and a model with others.

The ten parameters are mass, first moment and inertia about the point: m, mx, my, mz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz.
"""

from typing import Any

import numpy as np

from gcomp.arrays import Array

SIX = np.triu_indices(3)
"""Entries of a symmetric matrix in that order: xx, xy, xz, yy, yz, zz."""
LIGHT_KG = 1e-6
"""Least absolute mass of which a centre is taken [kg]."""
LEAST_SECOND_MOMENT = 1e-6
"""Least second moment of mass along a principal axis [kg·m²]."""


def symmetric(six: Array) -> Array:
    """Six entries (…, 6) as symmetric matrices (…, 3, 3)."""
    return np.asarray(six[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])


def pseudo_inertia(inertial: Array) -> Array:
    """The pseudo-inertia matrix (4, 4) of ten parameters: positive definite for every body that can exist (Wensing)."""
    inertia, out = symmetric(inertial[4:]), np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = inertial[1:4]
    out[3, 3] = inertial[0]
    return out


def inertial_of_pseudo(pseudo: Array) -> Array:
    """Ten parameters of a pseudo-inertia matrix (4, 4)."""
    inertia = np.trace(pseudo[:3, :3]) * np.eye(3) - pseudo[:3, :3]
    return np.concatenate([[pseudo[3, 3]], pseudo[:3, 3], inertia[SIX]])


def steiner(centre: Array) -> Array:
    """Inertia of a unit mass at a point (3,), about the origin (3, 3)."""
    return np.asarray(centre @ centre * np.eye(3) - np.outer(centre, centre))


def inertial_of(mass: float, centre: Array, inertia: Array) -> Array:
    """Ten parameters about the origin from mass [kg], centre [m] and inertia about the centre [kg·m²] (3, 3)."""
    return np.concatenate([[mass], mass * centre, (inertia + mass * steiner(centre))[SIX]])


def point_mass(mass: float, moment: Array) -> Array:
    """Ten parameters of a point mass (negative if it is taken away) from its mass and first moment."""
    centre = moment / mass if abs(mass) > LIGHT_KG else np.zeros(3)
    return np.concatenate([[mass], moment, mass * steiner(centre)[SIX]])


def point_slopes(mass: float, moment: Array) -> Array:
    """Derivative of `point_mass` in mass and moment, (10, 4); of its first four rows alone without a mass."""
    out = np.vstack([np.eye(4), np.zeros((6, 4))])
    if abs(mass) > LIGHT_KG:
        centre = moment / mass
        out[4:, 0], out[4:, 1:] = -steiner(centre)[SIX], moment_to_inertia(centre)
    return out


def moment_to_inertia(centre: Array) -> Array:
    """Change of the inertia about the joint with the first moment of a body with its centre of mass there, (6, 3).

    I = Σ m (|r|² 1 − r rᵀ), so moving mass at c by δ adds 2 (c·mδ) 1 − (c mδᵀ + mδ cᵀ), to first order.
    """
    outer = np.einsum("i,jk->kij", centre, np.eye(3))
    change = 2.0 * centre[:, None, None] * np.eye(3) - outer - outer.swapaxes(1, 2)
    return np.asarray(change[:, SIX[0], SIX[1]].T)


def move_mass(inertial: Array, moment: Array) -> Array:
    """A body whose first moment is larger by `moment` (3,): its centre moves, mass and inertia about it stay, (10,)."""
    mass, centre, about = mass_centre_inertia(inertial)
    return inertial_of(mass, centre + moment / mass, about)


def body_parameters(model: Any, body: int, origin: Array, turn: Array) -> Array:
    """Ten parameters of a body about a point of its frame, in a frame turned by `turn`."""
    import mujoco

    spin = np.zeros(9)
    mujoco.mju_quat2Mat(spin, model.body_iquat[body])
    axes = turn @ spin.reshape(3, 3)
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    return inertial_of(float(model.body_mass[body]), turn @ (model.body_ipos[body] - origin), inertia)


def fixed_body_parameters(model: Any, data: Any, fixed: int, body: int, anchor: Array) -> Array:
    """Ten parameters of a body that is fixed to another (or is it), about that one's anchor and in its frame.

    `data` has the places of both.
    """
    up, own = data.xmat[body].reshape(3, 3), data.xmat[fixed].reshape(3, 3)
    turn = up.T @ own
    place = up.T @ (data.xpos[fixed] - data.xpos[body]) - anchor
    return body_parameters(model, fixed, -turn.T @ place, turn)


def set_body(model: Any, body: int, anchor: Array, total: Array) -> bool:
    """Give a body ten inertial parameters about a point of it, or the closest that can exist; whether it has them."""
    import mujoco

    mass, centre, about = mass_centre_inertia(total)
    values, axes = np.linalg.eigh(about)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    spread = np.maximum(0.5 * values.sum() - values, LEAST_SECOND_MOMENT)
    possible = spread.sum() - spread  # none exceeds the sum of the other two
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = mass, anchor + centre, possible
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    model.body_sameframe[body] = 0  # else a body whose frames were one keeps its old centre of mass
    return bool(np.allclose(possible, values, rtol=1e-3, atol=1e-9) and mass == total[0])


def mass_centre_inertia(inertial: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass and inertia about it (3, 3) from ten inertial parameters about the origin."""
    mass = max(float(inertial[0]), LIGHT_KG)
    centre = inertial[1:4] / mass
    return mass, centre, symmetric(inertial[4:]) - mass * steiner(centre)


def write_bodies(spec: Any, nominal: Any, model: Any) -> None:
    """Write the bodies in which a compiled model differs from its nominal one into the specification of both."""
    fields = ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_gravcomp")
    changed = {
        i for field in fields for i in np.argwhere(getattr(model, field) != getattr(nominal, field))[:, 0].tolist()
    }
    for body in spec.bodies:
        if (i := body.id) in changed:
            body.explicitinertial, body.fullinertia = True, [np.nan] * 6
            body.mass, body.ipos, body.iquat = float(model.body_mass[i]), model.body_ipos[i], model.body_iquat[i]
            body.inertia, body.gravcomp = model.body_inertia[i], float(model.body_gravcomp[i])
