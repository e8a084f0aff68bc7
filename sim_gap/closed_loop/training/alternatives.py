"""What a choice of effects leaves open: the fits of other choices, by how likely these are.

An interval about one choice says how well its parameters are known if that choice is right. A spring in place of a part
of gravity, or a payload beside it, changes gain, friction and inertia together by factors, while each choice by itself
is told well. So parameters are distributed about several fits (averaging over models; Hoeting and others, Statistical
Science 14, 1999).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from gcomp.arrays import Array
from sim_gap.closed_loop.choice.doubt import Other
from sim_gap.closed_loop.fit import Fit

LEAST = 0.005
"""Probability below which another choice of effects is none."""
INSIDE = 0.95
"""Probability of an interval."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another fit that the parameters of one joint may be distributed about, or those of the whole arm."""

    joint: int
    """−1: all joints, and the parameters of the whole arm."""
    odds: float
    """Probability over that of the fit itself."""
    fit: Fit


def alternatives(others: Sequence[Other]) -> tuple[Alternative, ...]:
    """The other choices that are not beyond doubt."""
    return tuple(
        Alternative(joints[0] if joints else -1, each.likely / (1.0 - each.likely), each.fit)
        for each, joints in ((each, each.group[1]) for each in others)
        if LEAST < each.likely < 1.0
    )


def quantiles(shifts: Array, odds: Array, deviation: float) -> tuple[float, float]:
    """Ends of the INSIDE interval of a mixture of normal distributions with one standard deviation, about 0 and about
    `shifts`, the latter with `odds` over the first."""
    means, weights = np.append(0.0, shifts), np.append(1.0, odds) / (1.0 + odds.sum())
    deviation = max(deviation, 1e-12)
    far = norm.isf(0.25 * (1.0 - INSIDE) * weights[0]) * deviation

    def end(share: float) -> float:
        def above(x: float) -> float:
            return float(weights @ norm.cdf((x - means) / deviation)) - share

        return float(brentq(above, means.min() - far, means.max() + far))

    return end(0.5 - 0.5 * INSIDE), end(0.5 + 0.5 * INSIDE)
