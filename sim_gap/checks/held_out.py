"""Whether a corrected recording is predicted better than as it was recorded, by a sound arm with effects in both.

A wrong sign, order, zero or clock has to explain more than masses, friction, springs and offsets of usual size can: by
the likelihood of parts of the recording that are held out, as effects are chosen.
"""

from collections.abc import Iterable

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.choice import PRICE, SIGNIFICANT, HeldOutEvidence, LinearTerms
from gcomp.estimate.problem import Index
from sim_gap.checks.rigid_fit import FLOOR, ChannelMotion
from sim_gap.model.rigid_body import RigidArm
from sim_gap.search.term_equations import CORRELATED, MOST_MEASUREMENTS

OFF = 0.3
"""Standard deviation of gains, masses, springs and offsets of sound arms, as a share of the model's torque."""
FOLDS = 6
"""Parts of a recording of which each is held out once."""
CERTAIN = 5.0 * PRICE
"""Fall of the negative log likelihood from which a correction is certain: as rare an effect as any of the library has
paid then, and the choice among the hundred changes that are looked at."""


def shown_by(
    arms: Iterable[RigidArm], before: ChannelMotion, after: ChannelMotion, rows_per_s: float
) -> HeldOutEvidence:
    """How much better a corrected motion is predicted than it was before, each by the likelier of the arms: how a base
    is mounted may have been read off the recording with its fault."""
    scale = np.maximum(before.reading.std(0), after.reading.std(0))
    costs = [[_costs(arm, motion, scale, rows_per_s) for arm in arms] for motion in (before, after)]
    falls = min(costs[0], key=np.sum) - min(costs[1], key=np.sum)
    return HeldOutEvidence(float(falls.sum()), float(falls.std(ddof=1) * np.sqrt(len(falls))))


def is_certain(shown: HeldOutEvidence) -> bool:
    """Whether nothing but the fault that is corrected can be the reason."""
    return shown.fall > max(CERTAIN, SIGNIFICANT * shown.error)


def is_refuted(shown: HeldOutEvidence) -> bool:
    """Whether the recording is predicted worse with the correction."""
    return shown.fall < -SIGNIFICANT * shown.error


def _costs(arm: RigidArm, motion: ChannelMotion, scale: Array, rows_per_s: float) -> Array:
    """Negative logarithm of the likelihood of each held-out part, over all joints, (F,), and of such effects: a reading
    turned round is one of a gain of minus one, which no sensor has."""
    model, n = arm.carried(motion.q, motion.v, motion.a), arm.n
    size = np.maximum(model.std(0), 1e-9)
    fold = np.arange(len(model)) * FOLDS // len(model)
    # measurements are independent after the time in which residuals of real arms are correlated
    each = min(1.0, 24.0 / CORRELATED / rows_per_s, MOST_MEASUREMENTS / len(model))
    acting, squares, products = list[Index](), list[Array](), list[Array]()
    totals = np.zeros((n, FOLDS))
    spread, low, high = list[float](), list[float](), list[float]()
    for j in range(n):
        q = motion.q[:, j]
        columns = [model[:, j] / size[j], np.ones_like(q), np.sin(q), np.cos(q), q - q.mean()]
        friction = [motion.direction[:, j], motion.v[:, j], motion.a[:, j]]
        x, y = np.stack([*columns, *friction], axis=1), motion.reading[:, j] - model[:, j]
        acting.append(np.arange(len(spread), len(spread) + x.shape[1]))
        # a sensor on the link feels no gear: what rubs behind it is as small as other errors
        rubs = OFF * size[j] / np.maximum(np.std(friction, axis=1), 1e-9) if motion.channel == "tau" else 3 * [np.inf]
        spread += [*len(columns) * [OFF * size[j]], *rubs]
        low += [-np.inf] * len(columns) + [0.0] * len(friction)
        high += [np.inf] * x.shape[1]
        parts = [fold == f for f in range(FOLDS)]
        squares.append(np.stack([each * x[p].T @ x[p] for p in parts]))
        products.append(np.stack([-each * x[p].T @ y[p] for p in parts]))
        totals[j] = [each * float(y[p] @ y[p]) for p in parts]
    counts = np.tile([each * float((fold == f).sum()) for f in range(FOLDS)], (n, 1))
    floor, none = np.sqrt(FLOOR) * np.maximum(scale, 1e-9), np.zeros(len(spread))
    terms = LinearTerms(
        none, tuple(acting), tuple(squares), tuple(products), totals, counts, floor**2, floor, none,
        1.0 / np.array(spread) ** 2, none, np.array(low), np.array(high),
    )  # fmt: skip
    every = range(len(spread))
    terms = terms.reweighed(every)
    usual = 0.5 * float(terms.prior @ terms.fit(every) ** 2)
    return np.asarray(terms.costs(every).sum(0) + usual / FOLDS)
