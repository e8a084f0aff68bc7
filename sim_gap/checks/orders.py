"""Orders of the joints' columns that fit best, of all that there are: exchanges of two do not lead to every one."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from sim_gap.checks.hypotheses import permuted
from sim_gap.checks.rigid_fit import Motion, fit_models, least_costs, rows_of
from sim_gap.model.rigid_body import RigidArm

MOST = 7
"""Joints up to which all orders are tried, of which there are 5,040."""
ROWS = 50
"""Rows that tell how well an order fits."""
ROUGHLY, LIKELY = 200, 6
"""Orders that are kept by least squares alone, and of these by fits with physical signs."""


def likely_orders(arm: RigidArm, motion: Motion) -> list[tuple[tuple[int, ...], bool, bool]]:
    """Orders that fit the model best, each with whether columns of the positions have it, and those of the torques.

    None for an arm of many joints.
    """
    if arm.n > MOST:
        return []
    few = rows_of(motion, slice(None, None, max(1, len(motion.q) // ROWS)))
    orders = list(permutations(range(arm.n)))[1:]
    moved = [permuted(order, ("q", "v", "a"))(few) for order in orders]
    made = arm.carried(*(np.concatenate([getattr(each, name) for each in moved]) for name in ("q", "v", "a")))
    found = [(order, False, True) for order in _torque_orders(arm, few, orders)]
    both = [permuted(order, ("reading",))(each) for order, each in zip(orders, moved, strict=True)]
    for whole, motions in ((True, both), (False, moved)):
        pairs = list(zip(np.split(made, len(motions)), motions, strict=True))
        roughly = np.argsort(least_costs(pairs))[:ROUGHLY].tolist()
        costs = [fit.cost.sum() for fit in fit_models([pairs[k] for k in roughly])]
        found += [(orders[roughly[k]], True, whole) for k in np.argsort(costs)[:LIKELY].tolist()]
    return found


def _torque_orders(arm: RigidArm, few: Motion, orders: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """The likely orders of the torques alone: what is left of a joint's reading does not depend on the others'."""
    model, n = arm.carried(few.q, few.v, few.a), arm.n
    rolled = [np.roll(np.arange(n), -k).tolist() for k in range(n)]
    fits = fit_models([(model, permuted(order, ("reading",))(few)) for order in rolled])
    costs = np.empty((n, n))  # of each joint with each column
    for order, fit in zip(rolled, fits, strict=True):
        costs[np.arange(n), order] = fit.cost
    best = np.argsort(costs[np.arange(n), np.array(orders)].sum(axis=1))
    return [orders[k] for k in best[:LIKELY].tolist()]
