"""Optimal selection: which candidates, such as sweeps, together determine the parameters best (docs/theory.md, 7.4).

A selection is D-optimal: it makes the volume of the parameters' confidence ellipsoid smallest.
"""

from collections.abc import Callable, Sequence

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness
from gcomp.identify.parameters import Parameters, family_slices

MINIMUM_LEVER = 0.3
"""Γ/g of the swept joint below which a combination is used only if none is better (docs/theory.md, section 2.5)."""
MOST_COMBINATIONS = 256
"""Combinations of stops that a design chooses from, at most: all of nine joints; time grows with them, and few are
chosen."""
Cost = Callable[[list[list[int]], int, int], Array]
"""(selection until now, group, slot) → cost of each candidate of the group there (C,), as log determinant."""


def select(
    rows: Sequence[Array],
    prior: Array,
    counts: Sequence[int],
    *,
    cost: Cost | None = None,
    exchanges: int = 2,
) -> list[list[int]]:
    """Indices of the `counts` candidates of each group that together are best: a greedy selection, then exchanges.

    `rows` are the weighted Jacobians J (G, C, K, p) of each group's candidates, for G guesses at the parameters over
    which the log determinant is averaged; `prior` (G, p, p) is the information without any candidate, regular. `cost`
    is subtracted from it. `exchanges` are the rounds in which every selected candidate is compared once more with all
    others: more than two changed 4 of 28 designs (the paper's arm and ten random ones).
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
            score = _gain(total, each)
            if cost is not None:
                score -= cost(chosen, group, slot)
            score[[pick for other, pick in enumerate(picks) if other != slot]] = -np.inf
            best = [int(np.argmax(score))]
            changes += picks[slot : slot + 1] != best
            seen[group, slot], picks[slot : slot + 1] = changes, best
            total += _information(each[:, picks[slot]])
    return chosen


def stop_combinations(arm: Arm, joint: int) -> Array:
    """The 2^(n-1) poses (C, n) [rad] with the other joints at a limit and `joint` in the middle.

    Of an arm with more than 9 joints, `MOST_COMBINATIONS` of them, drawn. Raises BadArray if a joint has no limits.
    """
    for name, low, high in zip(arm.names, arm.lower, arm.upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise BadArray(f"joint {name} has no limits ({low} to {high} rad), so it has no stop to rest on")
    others = np.delete(np.arange(arm.n), joint)
    numbers = np.arange(2 ** len(others))
    if len(numbers) > MOST_COMBINATIONS:
        numbers = np.random.default_rng(0).choice(len(numbers), MOST_COMBINATIONS, replace=False)
    at_upper = (numbers[:, None] >> np.arange(len(others))[::-1]) & 1 == 1  # the last joint changes fastest
    poses = np.tile((arm.lower + arm.upper) / 2, (len(numbers), 1))
    poses[:, others] = np.where(at_upper, arm.upper[others], arm.lower[others])
    return poses


def sufficient_levers(lever: Array) -> Mask:
    """Levers Γ/g (C,) of at least `MINIMUM_LEVER`; if there is none, the better half."""
    good: Mask = lever >= MINIMUM_LEVER
    return good if good.any() else lever >= np.median(lever)


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


def _gain(total: Array, rows: Array) -> Array:
    """By how much each candidate's rows (G, C, K, p) raise the log determinant of the information `total` (G, p, p):
    (C,).

    By the matrix determinant lemma on the K readings of a candidate, which are fewer than the parameters: I + J P Jᵀ,
    with the covariance P before it.
    """
    covariance = np.linalg.inv(total)
    spread = rows @ covariance[:, None]
    gram = spread @ rows.swapaxes(-1, -2) + np.eye(rows.shape[-2])
    return np.asarray(np.linalg.slogdet(gram)[1].mean(axis=0))
