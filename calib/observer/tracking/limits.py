"""Detection limits: which change of each joint's sensor the observer would notice now (docs/theory.md)."""

from dataclasses import dataclass

import numpy as np

from calib.observer.cause_test import CauseTest
from calib.observer.config import ObserverConfig
from gcomp.arrays import Array

UNSEEN = 1.0
"""A gain whose limit is above this is not observed: gravity hardly loads the joint."""


@dataclass(frozen=True)
class Limits:
    """Smallest changes that are noticed, in one case of two; 1.5 times as large ones almost always."""

    gain: Array
    """Relative (n,); NaN if gravity does not load the joint."""
    offset: Array
    """(n,) [N·m]."""
    rests: int
    """Rests at other poses after which they are noticed."""


def limits(test: CauseTest, config: ObserverConfig, wait: int) -> Limits:
    """Limits in work at poses like those of a test.

    A change is noticed if it stands out of a window of the longest kind, by the rule of the cause test, and rows after
    it confirm it. `wait` is the number of rests until the first test.
    """
    count, n = test.window.position.shape
    longer = np.sqrt(config.longest_window / count)
    gain, offset = (np.array([test.noticed(cause, j) for j in range(n)]) / longer for cause in ("gain", "offset"))
    gain[~(gain <= UNSEEN)] = np.nan
    return Limits(gain, offset, wait + config.longest_window + 2 * config.window)
