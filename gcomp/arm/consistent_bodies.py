"""A model whose bodies have given mass moments and can exist: the closest such bodies to the model's own.

Gravity tells 2n combinations of masses and first moments. Among all bodies that have them, those with the least
entropic divergence from the model's are taken: tr(P₀⁻¹P) − log det(P₀⁻¹P), P the pseudo-inertia matrix, which is
positive definite for every body that can exist (Lee, Wensing and Park, IEEE Transactions on Robotics 36, 2020).
"""

import copy
from typing import Any

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.inertials import body_parameters, inertial_of_pseudo, pseudo_inertia, set_body
from gcomp.arm.load import PlacedChain, body_in_bar_frame
from gcomp.arm.mass_moments import base_parameters
from gcomp.arrays import Array

SMALLEST_SHARE = 1e-2
"""Mass of a body that the model gives none, as a share of the mean link; it is spread over half of a link's length."""
MOST_STAGES = 1000
"""One is usual; some thirty where bodies are multiplied by a hundred."""
MOST_STEPS = 50
"""Newton steps of a stage; ten are usual."""
RESOLUTION = float(np.finfo(float).eps)


def with_moments(placed: PlacedChain, beta: Array) -> Any:
    """A copy of the compiled model with mass moments β (2n,) [kg·m], of which each link's heaviest body changes.

    It is for `write_bodies`: what MuJoCo sums up when it compiles is as before.
    """
    arm, model = placed.arm.arm, copy.copy(placed.model)
    heaviest = [max(bodies, key=lambda body: float(model.body_mass[body])) for bodies in placed.bodies]
    frames = [body_in_bar_frame(placed, link, body) for link, body in enumerate(heaviest)]
    own = np.array(
        [body_parameters(model, body, -turn.T @ at, turn) for body, (turn, at) in zip(heaviest, frames, strict=True)]
    )
    rest = placed.arm.beta - base_parameters(arm, own[:, 0], own[:, 1:4])
    found = closest_bodies(arm, np.array([pseudo_inertia(each) for each in own]), beta - rest)
    for body, (turn, at), pseudo in zip(heaviest, frames, found, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn.T, -turn.T @ at
        set_body(model, body, np.zeros(3), inertial_of_pseudo(matrix @ pseudo @ matrix.T))
    return model


def closest_bodies(arm: Arm, nominal: Array, beta: Array) -> Array:
    """Pseudo-inertia matrices (n, 4, 4) in the bar frames with mass moments β (2n,) [kg·m], closest to `nominal`.

    Moments that are far from the nominal bodies' are approached in stages, each with the closest bodies to those of the
    stage before.
    """
    of = np.zeros((2 * arm.n, arm.n, 4, 4))
    for link in range(arm.n):
        mass, moments = np.zeros(arm.n), np.zeros((3, arm.n, 3))
        mass[link], moments[range(3), link, range(3)] = 1.0, 1.0
        of[:, link, 3, 3] = base_parameters(arm, mass, np.zeros((arm.n, 3)))
        for axis, moment in enumerate(moments):
            half = base_parameters(arm, np.zeros(arm.n), moment) / 2
            of[:, link, axis, 3] = of[:, link, 3, axis] = half
    bodies, reached = _spread(arm, nominal, beta), False
    for _ in range(MOST_STAGES):
        bodies, reached = _stage(of, bodies, beta)
        if reached:
            break
    return bodies


def _stage(of: Array, nominal: Array, beta: Array) -> tuple[Array, bool]:
    """Bodies closest to the nominal ones with moments β_i = Σ tr(of_i P) on the way to β, and whether they have β.

    The dual problem has no constraint: −log det(1 + Σ λ_i C_i) + λ·β, P = (1 + Σ λ_i C_i)⁻¹, in coordinates in which
    the nominal bodies are 1. Newton steps go far enough for a few of them to do.
    """
    root = np.linalg.cholesky(nominal)
    own = np.einsum("lji,cljk,lkm->clim", root, of, root)
    size = np.sqrt((own**2).sum(axis=(1, 2, 3)))
    acts = size > RESOLUTION * size.max()
    own = own[acts] / size[acts, None, None, None]
    now = np.einsum("clii->c", own)
    gap = beta[acts] / size[acts] - now
    curvature = np.einsum("clij,dlji->cd", own, own)
    share = min(1.0, 1.0 / np.sqrt(max(float(gap @ np.linalg.solve(curvature, gap)), 1.0)))
    target, price = now + share * gap, np.zeros(len(gap))

    def cost(price: Array) -> tuple[float, Array]:
        inverse = np.eye(4) + np.einsum("c,clij->lij", price, own)
        if np.linalg.eigvalsh(inverse).min() <= 0:
            return np.inf, inverse
        return float(price @ target - np.linalg.slogdet(inverse)[1].sum()), np.linalg.inv(inverse)

    least, bodies = cost(price)
    for _ in range(MOST_STEPS):
        turned = np.einsum("clij,ljk->clik", own, bodies)
        gradient = target - np.einsum("clii->c", turned)
        step = -np.linalg.solve(np.einsum("clij,dlji->cd", turned, turned), gradient)
        length = 1.0
        while (after := cost(price + length * step))[0] > least and length > RESOLUTION:
            length /= 2
        if length <= RESOLUTION:  # nothing is lower but for rounding
            break
        price, (least, bodies) = price + length * step, after
    found: Array = root @ bodies @ np.swapaxes(root, 1, 2)
    return found, share == 1.0


def _spread(arm: Arm, nominal: Array, beta: Array) -> Array:
    """Pseudo-inertias (n, 4, 4) that are positive definite: a body without mass or extent gets a little of both."""
    length = float(np.linalg.norm(arm.span, axis=1).mean()) or 0.1
    mean = max(float(nominal[:, 3, 3].mean()), float(np.abs(beta).max()) / length) or 1.0
    least = SMALLEST_SHARE * mean * np.diag([(length / 2) ** 2] * 3 + [1.0])
    root = np.sqrt(np.diag(least))
    spread = nominal.copy()
    for link, each in enumerate(nominal):
        if np.linalg.eigvalsh(each / np.outer(root, root)).min() < SMALLEST_SHARE:
            spread[link] += least
    return spread
