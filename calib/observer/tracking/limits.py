"""Detection limits: which change of each joint's sensor the observer would notice now (docs/theory.md)."""

from dataclasses import dataclass

import numpy as np

from calib.observer.config import ObserverConfig
from calib.observer.gravity_belief import Expected
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


def limits(expected: Expected, torque: Array, sigma: Array, config: ObserverConfig, wait: int) -> Limits:
    """Limits in work at K poses; torque (K, n) [N·m] of the model there, sigma (n,) [N·m] the noise of a row.

    A change is noticed if it stands out of a window of the longest kind, by the rule of the cause test, and rows after
    it confirm it. `wait` is the number of rests until the first test.
    """
    count, n = torque.shape
    threshold = np.sqrt(config.evidence + np.log(config.longest_window * n))
    gain, offset = np.empty(n), np.empty(n)
    for j in range(n):
        covariance = expected.of_joint(j) + sigma[j] ** 2 * np.eye(count)
        columns = np.column_stack([torque[:, j], np.ones(count)])
        information = (
            np.einsum("ka,ka->a", columns, np.linalg.solve(covariance, columns)) * config.longest_window / count
        )
        gain[j], offset[j] = threshold / np.sqrt(np.maximum(information, 1e-30))
    gain[gain > UNSEEN] = np.nan
    return Limits(gain, offset, wait + config.longest_window + 2 * config.window)
