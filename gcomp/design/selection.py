"""Optimal selection: which candidates together determine the parameters best.

A D-optimal selection makes the volume of the parameters' confidence ellipsoid smallest, an A-optimal one the sum of
their variances in natural units.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.parameters import Parameters, family_slices

Criterion = Literal["D", "A"]
Cost = Callable[[list[list[int]], int, int], Array]
"""(selection until now, group, slot) → cost of each candidate of the group there (C,), as log determinant."""


def select(
    rows: Sequence[Array],
    prior: Array,
    counts: Sequence[int],
    *,
    criterion: Criterion = "D",
    unit: ArrayLike = 1.0,
    cost: Cost | None = None,
    exchanges: int = 2,
) -> list[list[int]]:
    """Indices of the `counts` candidates of each group that together are best: a greedy selection, then exchanges.

    `rows` are the weighted Jacobians J (G, C, K, p) of each group's candidates, for G guesses at the parameters over
    which the criterion is averaged; `prior` (G, p, p) is the information without any candidate, regular. `unit` (p,)
    is the natural unit of each parameter, for the A criterion; `cost` is subtracted from the criterion. `exchanges`
    are the rounds in which every selected candidate is compared once more with all others: more than two changed 4 of
    28 designs (the paper's arm and ten random ones, both criteria).
    """
    total = prior.copy()
    chosen: list[list[int]] = [[] for _ in rows]
    slots = [(group, slot) for group, each in enumerate(rows) for slot in range(min(counts[group], each.shape[1]))]
    changes, seen = 0, dict[tuple[int, int], int]()
    for turn in range(1 + exchanges):
        for group, slot in slots:
            each, picks = rows[group], chosen[group]
            if turn:
                if seen[group, slot] == changes:  # compared with all others already, among the same selection
                    continue
                total -= _information(each[:, picks[slot]])
            score = _gain(total, each, criterion, unit)
            if cost is not None:
                score -= cost(chosen, group, slot)
            score[[pick for other, pick in enumerate(picks) if other != slot]] = -np.inf
            best = [int(np.argmax(score))]
            changes += picks[slot : slot + 1] != best
            seen[group, slot], picks[slot : slot + 1] = changes, best
            total += _information(each[:, picks[slot]])
    return chosen


def sweep_jacobian(
    arm: Arm, guess: Parameters, joint: int, poses: Array, sigma: Array, free: Mask, loads: Sequence[float]
) -> Array:
    """Jacobian (C, L·S, p) of the swept joint's readings along candidate sweeps, over their standard deviation.

    poses (C, S, n) [rad] are position readings, repeated with each of L loads [kg]; sigma (n,) [N·m]; columns are the
    p parameters marked in `free` (6n + 3,). Equal to `predict_and_jacobian`, for one joint without the others' rows.
    """
    n, gain = arm.n, guess.gain[joint]
    at_origin, by_point = payload_columns(arm)
    q = poses * guess.position_gain + guess.position_offset
    regressor = gravity_regressor(arm, q)[..., joint, :]
    places, parts = family_slices(n), []
    for load in loads:
        loaded = guess.beta + load * (at_origin + by_point @ guess.rho)
        stiffness = gravity_stiffness(arm, loaded, q)[..., joint, :] * gain
        jacobian = np.zeros((*poses.shape[:2], 6 * n + 3))
        jacobian[..., places["gain"].start + joint] = regressor @ loaded
        jacobian[..., places["offset"].start + joint] = 1.0
        jacobian[..., places["position_gain"]] = stiffness * poses
        jacobian[..., places["position_offset"]] = stiffness
        jacobian[..., places["beta"]] = regressor * gain
        jacobian[..., places["rho"]] = load * regressor @ by_point * gain
        parts.append(jacobian[..., np.flatnonzero(free)] / sigma[joint])
    return np.ascontiguousarray(np.concatenate(parts, axis=1))


def _information(rows: Array) -> Array:
    """JᵀJ (G, p, p) of weighted Jacobians (G, K, p)."""
    return np.asarray(rows.swapaxes(-1, -2) @ rows)


def _gain(total: Array, rows: Array, criterion: Criterion, unit: ArrayLike) -> Array:
    """How much better each candidate's rows (G, C, K, p) make the information `total` (G, p, p): (C,).

    By the matrix determinant lemma and Woodbury's identity on the K readings of a candidate, which are fewer than the
    parameters: I + J P Jᵀ, with the covariance P before it.
    """
    covariance = np.linalg.inv(total)
    spread = rows @ covariance[:, None]
    gram = spread @ rows.swapaxes(-1, -2) + np.eye(rows.shape[-2])
    if criterion == "D":
        return np.asarray(np.linalg.slogdet(gram)[1].mean(axis=0))
    saved = (spread * np.linalg.solve(gram, spread)).sum(axis=-2) / np.square(unit)
    return np.asarray(saved.sum(axis=-1).mean(axis=0))
