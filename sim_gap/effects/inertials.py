"""Inertial parameters of a link with effects: mass, first moment, inertia about its joint, as in `rigid_body.INERTIAL`.

A moved centre of mass keeps the inertia about itself; a payload is a point mass. Both are exact, so that what is found
is a body that can exist.
"""

import numpy as np

from gcomp.arrays import Array

SIX = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
LIGHT_KG = 1e-6
"""Least absolute mass of which a centre is taken [kg]."""


def point(mass: float, moment: Array) -> Array:
    """Ten parameters of a point mass (negative if it is taken away) from its mass and first moment."""
    centre = moment / mass if abs(mass) > LIGHT_KG else np.zeros(3)
    inertia = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[mass], moment, inertia[SIX]])


def point_slopes(mass: float, moment: Array) -> Array:
    """Derivative of `point` in mass and moment, (10, 4); of its first four rows alone without a mass."""
    out = np.vstack([np.eye(4), np.zeros((6, 4))])
    if abs(mass) > LIGHT_KG:
        centre = moment / mass
        out[4:, 0] = -(centre @ centre * np.eye(3) - np.outer(centre, centre))[SIX]
        out[4:, 1:] = moment_to_inertia(centre)
    return out


def mounted(axis: Array, angle: float) -> Array:
    """Mass and first moment of a body that is turned about an axis (3,) by an angle, from those before, (4, 4)."""
    x, y, z = axis
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.eye(4)
    out[1:, 1:] += np.sin(angle) * hat + (1.0 - np.cos(angle)) * hat @ hat
    return out


def moment_to_inertia(centre: Array) -> Array:
    """Change of the inertia about the joint with the first moment of a body with its centre of mass there, (6, 3).

    I = Σ m (|r|² 1 − r rᵀ), so moving mass at c by δ adds 2 (c·mδ) 1 − (c mδᵀ + mδ cᵀ), to first order.
    """
    out = np.empty((6, 3))
    for k, unit in enumerate(np.eye(3)):
        change = 2.0 * centre @ unit * np.eye(3) - np.outer(centre, unit) - np.outer(unit, centre)
        out[:, k] = change[SIX]
    return out


def moved(inertial: Array, moment: Array) -> Array:
    """A link whose first moment is larger by `moment` (3,): its centre moves, mass and inertia about it stay, (10,)."""
    mass = max(float(inertial[0]), 1e-9)
    old, new = inertial[1:4] / mass, (inertial[1:4] + moment) / mass
    change = mass * (new @ new - old @ old) * np.eye(3) - mass * (np.outer(new, new) - np.outer(old, old))
    return np.concatenate([inertial[:1], inertial[1:4] + moment, inertial[4:] + change[SIX]])


def pseudo_inertia(inertial: Array) -> Array:
    """The pseudo-inertia matrix (4, 4) of ten parameters: positive definite for every body that can exist (Wensing)."""
    inertia = inertial[4:][[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = inertial[1:4]
    out[3, 3] = inertial[0]
    return out
