"""Positions that were read less often than the rows come, and are held over several."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.clock import fast_rows
from sim_gap.checks.finding import Finding

HELD = 0.3
"""Share of the rows in fast motion that repeat all positions, from which they are held."""


def without_held(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with positions that were read less often than the rows come, and repeated, filled in between."""
    same = _repeats(recording.position) & fast_rows(recording.position)
    share = float(same.sum()) / max(float(fast_rows(recording.position).sum()), 1.0)
    if share < HELD:
        return recording, []
    velocity = recording.velocity
    if velocity is not None and np.mean(_repeats(velocity)[same]) > 0.5:
        velocity = _filled(recording.t, velocity, ~same)
    position = _filled(recording.t, recording.position, ~same)
    evidence = f"repeats in {share:.0%} of the rows in motion while torques change: read less often; filled in between"
    found = Finding("duplicate", "q", "all", evidence, "record at the rate at which positions are read", True)
    return replace(recording, position=position, velocity=velocity), [found]


def _repeats(values: Array) -> NDArray[np.bool_]:
    """Rows in which all columns repeat the row before, (K,)."""
    return np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])


def _filled(t: Array, values: Array, known: NDArray[np.bool_]) -> Array:
    """Values (K, n), between the rows that are known along straight lines."""
    return np.column_stack([np.interp(t, t[known], column[known]) for column in values.T])
