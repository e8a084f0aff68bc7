"""Motion with the servo on and with it off, of which a fit sees as much.

A joint that swings free goes astray by tenths of a radian where one that is held is off by milliradians: of both
together a sum of squares shows the swing alone.
"""

from dataclasses import replace

import numpy as np

from sim_gap.closed_loop.fit import Fit, evaluate
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.windows import Windows

LEAST = 0.02
"""What a window counts at least, over one of the other kind."""


def counted(search: Search, data: Windows, fit: Fit | None = None) -> Windows:
    """The windows as a search counts them: both kinds as much, and nothing of joints that rest, of which any friction
    holds the place."""
    data = balanced(data, fit)
    if not search.resting:
        return data
    moves = [j not in search.resting for j in range(data.joints)]
    return replace(data, weight=data.weight * np.array(moves, float)[:, None])


def balanced(data: Windows, fit: Fit | None = None) -> Windows:
    """The windows, with each in which a joint's servo is mostly off counted less, such that both kinds leave as much.

    What they leave is what the fit leaves of them; without a fit, the way to the command, and the motion while there is
    none. Where a servo is never off, or always, nothing changes.
    """
    off = data.served.mean(0) < 0.5
    if not off.any():
        return data
    if fit is None:
        way = np.where(data.served > 0.5, data.command - data.recorded, data.recorded - data.recorded.mean(0))
        squares = np.mean(way**2, axis=0)
    else:
        left = evaluate(data, fit).rms
        assert left is not None
        squares = left**2
    count = data.weight.sum(0)
    on_mean, off_mean = (
        (squares * count * kind).sum(1) / np.maximum((count * kind).sum(1), 1e-300) for kind in (~off, off)
    )
    share = np.sqrt(on_mean / np.maximum(off_mean, 1e-300))
    share = np.where((on_mean > 0.0) & (off_mean > 0.0), np.clip(share, LEAST, 1.0), 1.0)
    return replace(data, weight=data.weight * np.where(off, share[:, None], 1.0))
