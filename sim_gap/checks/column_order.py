"""Orders of the joints' columns: those of all that fit best, and one that changes within a recording."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.hypotheses import Hypothesis, hypotheses, permute
from sim_gap.checks.rigid_fit import FEW, SCREENED, ChannelMotion, fit_model, fit_models, least_costs, rows_of
from sim_gap.checks.torque_unit import find_absent
from sim_gap.model.rigid_body import RigidArm

MOST = 7
"""Joints up to which all orders are tried, of which there are 5,040."""
ROUGHLY, LIKELY = 200, 6
"""Orders that are kept by least squares alone, and of these by fits with physical signs."""


def likely_orders(arm: RigidArm, motion: ChannelMotion) -> list[tuple[tuple[int, ...], bool, bool]]:
    """Orders that fit the model best, each with whether columns of the positions have it, and those of the torques.

    None for an arm of many joints, or of one.
    """
    if not 1 < arm.n <= MOST:
        return []
    few = rows_of(motion, slice(None, None, max(1, len(motion.q) // 50)))
    orders = list(permutations(range(arm.n)))[1:]
    moved = [permute(order, ("q", "v", "a"))(few) for order in orders]
    made = arm.carried(*(np.concatenate([getattr(each, name) for each in moved]) for name in ("q", "v", "a")))
    found = [(order, False, True) for order in _torque_orders(arm, few, orders)]
    both = [permute(order, ("reading",))(each) for order, each in zip(orders, moved, strict=True)]
    for whole, motions in ((True, both), (False, moved)):
        pairs = list(zip(np.split(made, len(motions)), motions, strict=True))
        roughly = np.argsort(least_costs(pairs))[:ROUGHLY].tolist()
        costs = [fit.cost.sum() for fit in fit_models([pairs[k] for k in roughly])]
        found += [(orders[roughly[k]], True, whole) for k in np.argsort(costs)[:LIKELY].tolist()]
    return found


def _torque_orders(arm: RigidArm, few: ChannelMotion, orders: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """The likely orders of the torques alone: what is left of a joint's reading does not depend on the others'."""
    model, n = arm.carried(few.q, few.v, few.a), arm.n
    rolled = [np.roll(np.arange(n), -k).tolist() for k in range(n)]
    fits = fit_models([(model, permute(order, ("reading",))(few)) for order in rolled])
    costs = np.empty((n, n))  # of each joint with each column
    for order, fit in zip(rolled, fits, strict=True):
        costs[np.arange(n), order] = fit.cost
    best = np.argsort(costs[np.arange(n), np.array(orders)].sum(axis=1))
    return [orders[k] for k in best[:LIKELY].tolist()]


CLEAR = 0.6
"""Fall of the cost, with an order in a part of the rows, from which it is asked about: on sound recordings of real arms
none reaches 0.1, on those with two torques exchanged from the middle on they reach 1.2 and more."""
UNEVEN = 1.0
"""Fall of the cost from all rows to one half of them from which a torque may be absent from the other."""
TRIED, LOCATED = np.linspace(0.25, 0.75, 3), np.linspace(0.05, 0.95, 37)
"""Shares of the rows after which the order is tried to change, and those among which that place is then sought."""


def find_changed_order(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """An order of the torque columns that the rows before or after some place alone have; `arm` is as mounted."""
    model = arm.carried(motion.q, motion.v, motion.a)
    orders = [h for h in hypotheses(arm, motion, stated, ()) if h.kind == "order"]
    own_orders = [h for h in orders if h.channels == (motion.channel,)]
    tried = [(own, late, share) for own in own_orders for late in (False, True) for share in TRIED]
    if not tried:
        return []
    few = rows_of(motion, slice(None, None, FEW))
    fits = fit_models([(model[::FEW], each) for each in (few, *(_in_part(few, *each) for each in tried))])
    roughly = np.array([fit.cost.sum() for fit in fits])
    own, late, _ = tried[int(np.argmin(roughly[1:]))]
    whole, fall, share = float(fit_model(model, motion).cost.sum()), 0.0, 0.0
    if roughly[0] - roughly[1:].min() > SCREENED * CLEAR:
        located = fit_models([(model, _in_part(motion, own, late, each)) for each in LOCATED])
        costs = [fit.cost.sum() for fit in located]
        fall, share = whole - float(min(costs)), float(LOCATED[np.argmin(costs)])
    if fall < CLEAR:
        return _absent_from_a_half(arm, motion, model, whole, stated)
    part = f"{'after' if late else 'before'} {share:.0%} of the recording"
    evidence = f"{own.what} only {part}: with that the model explains much more"
    option = f"give both parts as recordings of their own, the {'later' if late else 'earlier'} with {own.option}"
    return [RecordingFinding("order", motion.channel, arm.names[own.joints[0]], evidence, option, False, fall)]


def _absent_from_a_half(
    arm: RigidArm, motion: ChannelMotion, model: Array, whole: float, stated: Corrections
) -> list[RecordingFinding]:
    """Joints whose torque is absent from one half of the rows, where the model explains the other far better.

    `whole` is the cost of all rows.
    """
    middle = len(model) // 2
    halves = {"first": slice(None, middle), "second": slice(middle, None)}
    fits = {half: fit_model(model[rows], rows_of(motion, rows)) for half, rows in halves.items()}
    if whole - min(float(fit.cost.sum()) for fit in fits.values()) < UNEVEN:
        return []
    for half, rows in halves.items():
        for found in find_absent(arm, fits[half], rows_of(motion, rows), stated):
            option = f"give both halves as recordings of their own, this one with {found.option}"
            return [
                replace(found, evidence=f"only in the {half} half of the recording: {found.evidence}", option=option)
            ]
    return []


def _in_part(motion: ChannelMotion, order: Hypothesis, late: bool, share: float) -> ChannelMotion:
    """The motion with an order of its readings before, or after, a share of the rows."""
    row = round(share * len(motion.q))
    before, after = (motion, order.change(motion)) if late else (order.change(motion), motion)
    return replace(motion, reading=np.concatenate([before.reading[:row], after.reading[row:]]))
