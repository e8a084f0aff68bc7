"""Positions that were read less often than the rows come, and are held over several."""

from dataclasses import replace

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.checks.finding import Finding
from sim_gap.checks.rows.clock import fast_rows

HELD = 0.3
"""Share of the rows in fast motion that repeat all positions, from which they are held."""


def without_held(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording with positions that were read less often than the rows come, and repeated, filled in between."""
    same = _repeats(recording.position) & fast_rows(recording.position)
    share = float(same.sum()) / max(float(fast_rows(recording.position).sum()), 1.0)
    if share < HELD:
        return recording, []
    velocity, known = recording.velocity, np.repeat(~same[:, None], recording.n, axis=1)
    if velocity is not None and np.mean(_repeats(velocity)[same]) > 0.5:
        velocity = filled(recording.t, velocity, known)
    position = filled(recording.t, recording.position, known)
    evidence = f"repeats in {share:.0%} of the rows in motion while torques change: it is read less often; interpolated"
    found = Finding("duplicate", "q", "all", evidence, "record at the rate at which positions are read", True)
    return replace(recording, position=position, velocity=velocity), [found]


def _repeats(values: Array) -> Mask:
    """Rows in which all columns repeat the row before, (K,)."""
    return np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])


def filled(t: Array, values: Array, known: Mask) -> Array:
    """Values (K, n), along straight lines between those that are `known` (K, n); columns without any are 0."""
    return np.column_stack(
        [np.interp(t, t[k], x[k]) if k.any() else np.zeros_like(t) for k, x in zip(known.T, values.T, strict=True)]
    )
